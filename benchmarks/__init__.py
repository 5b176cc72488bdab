"""Speed beside bare pyzmq in the same run: `python -m benchmarks`."""
