"""The experiment in the browser and over HTTP.

Theory of operation
-------------------

`dashboard/` serves pages for people, `gateway/` a JSON API for programs. Both are components (`component`): messages
published so far come from the record (`archive`), later ones from their subscriptions. The component's thread
writes the messages into a `Watch`; the server's thread (`server`) reads them under its lock. Requests of a person go to
the scheduler over a separate connection for each person (`persons`, `person_commands`): roles, limits and arbitration
hold as for any other client. A name is accepted only with its password (`passwords`), and a request is answered only if
it comes from an allowed origin (`asgi`), also on loopback: any web site in the same browser could otherwise steer.

No data is pushed. The browser requests the newest picture after it has drawn the last one, and the other contents are
sent only after the browser has confirmed the previous ones. So a slow line gets fewer pictures, and no queue grows.
Pictures are PNG with a colour map: raw values would be eight times as large.

Invariants: a slow browser delays only its own page; nothing is drawn twice for two viewers; other processes
have priority for the processor.
"""
