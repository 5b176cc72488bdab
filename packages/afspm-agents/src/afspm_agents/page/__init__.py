"""Parts of the page with which a person approves the plans of agents."""
