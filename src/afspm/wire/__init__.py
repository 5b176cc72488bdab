"""The wire format: model objects and messages to and from the bytes that travel between processes."""

from __future__ import annotations

from afspm.wire.codec import decode, encode, header
from afspm.wire.frames import (
    decode_packet,
    decode_parameter,
    decode_request,
    decode_response,
    encode_packet,
    encode_request,
    encode_response,
    encode_subject,
    encode_time,
)
from afspm.wire.mapping import decode_orders, encode_orders
from afspm.wire.messages import (
    MessageDeclaration,
    MessageKind,
    declaration,
    declare,
    declared,
    followed_messages,
    known_messages,
    message_of,
    message_type,
    messages_of_the_experiment,
    messages_without_values,
    register,
)
from afspm.wire.protocol import (
    BEAT,
    CLOSE,
    CLOSING,
    KILL,
    PROTOCOL_VERSION,
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
    "declaration",
    "declare",
    "declared",
    "decode",
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
    "known_messages",
    "message_of",
    "message_type",
    "messages_of_the_experiment",
    "messages_without_values",
    "place_in",
    "register",
    "relocated",
]
