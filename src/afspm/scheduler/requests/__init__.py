"""Decisions about requests: five stages from arrival to answer, and the queue to the translator."""
