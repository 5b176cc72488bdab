"""Judges the watch on running scans over simulated nights; see `benchmarks.line_watch.nights`."""
