"""How fast it is, beside bare pyzmq in the same run: `python -m benchmarks`."""
