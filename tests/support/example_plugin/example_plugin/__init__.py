"""A laboratory's own package, which joins afspm by being installed."""
