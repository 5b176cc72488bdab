"""The record of an experiment: its journal, its measurements as files, and what is made of them."""
