"""Six families of four tasks each. Each module defines `TASKS`, the task generators by name."""
