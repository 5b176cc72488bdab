"""One drawing kit for notebooks, the report, figures and the dashboard."""
