"""Metrics: one class each, found by their `_target_` in conf/eval or by an entry point."""
