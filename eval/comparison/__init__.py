"""Compares runs: reads their folders, and puts their figures side by side and beside published ones."""
