"""What every process of an experiment shares: host, bond to the parent, loading of classes, failures, log, memory."""
