"""Simulated campaigns: worlds, routes, actors, sensors, recorded as ROS bags with their truth."""
