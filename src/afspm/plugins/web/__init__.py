"""The experiment in the browser and over HTTP.

Theory of operation
-------------------

`dashboard/` serves pages for people, `gateway/` a JSON API for programs. Both are components (`component`): what was
published so far comes from the record (`archive`), everything later from their subscriptions. The component's thread
writes it into a `Watch`; the server's thread (`server`) reads it under the watch's lock. Requests of a person go to the
scheduler over a connection of that person's own (`persons`, `person_commands`): roles, limits and arbitration hold as
for any other client. A name is believed only with its password (`passwords`), and a request is answered only if it
comes from an allowed origin (`asgi`).

What always holds: a slow browser delays nothing but itself; nothing is drawn twice for two viewers; other processes
have the processor first.
"""
