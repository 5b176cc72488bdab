"""The experiment over HTTP, for programs in any language."""

from __future__ import annotations

from afspm.plugins.web.gateway.gateway import Gateway

__all__ = ["Gateway"]
