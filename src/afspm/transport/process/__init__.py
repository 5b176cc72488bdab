"""The context of an experiment's process: bond to the parent, loading of classes, signals, failures, log."""
