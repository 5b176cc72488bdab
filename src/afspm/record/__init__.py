"""What is kept of an experiment: its journal, its measurements as files, and what can be made of them."""
