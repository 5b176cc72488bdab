"""Ready-made components, a module each: an experiment file names their classes without a module."""
