"""Decisions for the tip: limits at the moment of sending, and the watchdog when a holder dies."""
