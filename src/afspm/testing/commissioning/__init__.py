"""Commissioning of a controller: `afspm commission` takes a physicist through it step by step, with the tip withdrawn
first. The steps go through the scheduler and the translator of the experiment file, within its limits."""
