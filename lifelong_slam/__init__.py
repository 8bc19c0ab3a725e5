"""Lifelong LiDAR SLAM: scans in, an optimised trajectory and a map out."""

__version__ = "0.1.0"
