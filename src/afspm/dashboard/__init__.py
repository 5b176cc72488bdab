"""The experiment in the browser: seen by everybody, steered by those who may."""
