"""A laboratory's own package, which extends afspm once it is installed."""
