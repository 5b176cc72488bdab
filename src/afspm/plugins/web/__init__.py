"""The parts that dashboard and gateway share: passwords, the server, what was published, requests for persons."""
