"""The wire format: conversion between bytes and values of the model. The only package that uses protobuf.

**Theory of operation.** `proto/` defines the messages of the paper; a build step generates Python classes from
it. One registry declares each message once: its name, its envelope, whether it is a measurement or a state, the
handler of a component for it. Every other list of messages is derived from the registry.

    inputs        frames from sockets and the packet log; values of the model
    state         the registry; the user's message types are added to it once, at the start of a process
    outputs       values of the model; bytes
    invariants    equal values give equal bytes (reference bytes in `proto/golden.json`); unreadable bytes raise
                  WireError and disturb no other message; a scan's values are a view of the received buffer, unless
                  the peer sent them in several pieces
"""

from __future__ import annotations

from afspm.wire.codec import as_plain, as_text, decode, encode, header
from afspm.wire.frames import (
    BEAT,
    CLOSE,
    CLOSING,
    KILL,
    PROTOCOL_VERSION,
    decode_packet,
    decode_parameter,
    decode_request,
    decode_response,
    encode_packet,
    encode_request,
    encode_response,
    encode_subject,
    encode_time,
    id_of,
)
from afspm.wire.mapping import decode_instrument_orders, decode_orders, encode_orders, timestamp
from afspm.wire.messages import (
    MessageDeclaration,
    MessageKind,
    declaration,
    declare,
    declared,
    followed_messages,
    is_of_afspm,
    is_relayed,
    known_messages,
    message_of,
    message_type,
    messages_of_the_experiment,
    messages_without_values,
    register,
)
from afspm.wire.split import Buffer
from afspm.wire.values import encode_place, place_in, relocated

__all__ = [
    "BEAT",
    "CLOSE",
    "CLOSING",
    "KILL",
    "PROTOCOL_VERSION",
    "Buffer",
    "MessageDeclaration",
    "MessageKind",
    "as_plain",
    "as_text",
    "declaration",
    "declare",
    "declared",
    "decode",
    "decode_instrument_orders",
    "decode_orders",
    "decode_packet",
    "decode_parameter",
    "decode_request",
    "decode_response",
    "encode",
    "encode_orders",
    "encode_packet",
    "encode_place",
    "encode_request",
    "encode_response",
    "encode_subject",
    "encode_time",
    "followed_messages",
    "header",
    "id_of",
    "is_of_afspm",
    "is_relayed",
    "known_messages",
    "message_of",
    "message_type",
    "messages_of_the_experiment",
    "messages_without_values",
    "place_in",
    "register",
    "relocated",
    "timestamp",
]
