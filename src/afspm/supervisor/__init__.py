"""Starts the components of an experiment as processes, watches over them, restarts what dies, and ends them."""
