"""Judges SLAM runs by the standard files they leave; knows no particular SLAM system."""
