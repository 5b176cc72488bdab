"""One kit for every picture: notebooks, the report, figures and the dashboard draw with it."""
