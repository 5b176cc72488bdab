"""Six families of four tasks each. A module has `TASKS`: generators by name."""
