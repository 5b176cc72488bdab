"""The checks of a client, by subject."""
