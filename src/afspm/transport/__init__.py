"""ZeroMQ: publishers, subscribers, requests, heartbeats and keys. Nothing else imports zmq."""
