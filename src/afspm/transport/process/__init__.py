"""The context of a process of an experiment: bond to the parent, loading of classes, signals, failures, log."""
