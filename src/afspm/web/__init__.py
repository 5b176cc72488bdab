"""What the dashboard and the gateway share: who may come in, the server, what was published, and acting for persons."""
