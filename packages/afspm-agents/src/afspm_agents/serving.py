"""HTTP server of the agents' tools, behind the gateway's access checks."""

from __future__ import annotations

from collections.abc import Collection

from mcp.server.transport_security import TransportSecuritySettings

from afspm.plugins.web.asgi import AsgiApp
from afspm.plugins.web.gateway.guard import GatewayGuard
from afspm.plugins.web.passwords import Passwords
from afspm_agents.tools import AgentTools

PATH = "/mcp"


def application(tools: AgentTools, passwords: Passwords, *, host: str, origins: Collection[str] = ()) -> AsgiApp:
    """Return the HTTP application; `GatewayGuard` checks name, token, origin and host of each request first."""
    # the guard checks host and origin for both eras of the protocol, and off loopback as well
    security = TransportSecuritySettings(enable_dns_rebinding_protection=False)
    # no sessions for the older era: callers without a name could use them all up, and no agent could call `stop`
    app = tools.server().streamable_http_app(
        streamable_http_path=PATH, transport_security=security, host=host, stateless_http=True
    )
    guarded: AsgiApp = GatewayGuard(app, passwords, host, origins)
    return guarded
