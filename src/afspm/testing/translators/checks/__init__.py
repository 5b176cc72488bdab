"""The checks of a translator, by subject."""
