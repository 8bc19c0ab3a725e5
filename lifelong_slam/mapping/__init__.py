"""Keyframes, submaps and the static map."""
