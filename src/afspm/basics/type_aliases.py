"""Type aliases of `type` statements (Python 3.12): the type that such a name stands for."""

from __future__ import annotations

from typing import Any, TypeVar, get_args, get_origin


def unaliased(type_: Any) -> Any:
    """Return the type that a `type` alias names, with the arguments of the alias; any other type unchanged.

    `get_origin` and `isinstance` do not look through such aliases. numpy's `NDArray` has been one since numpy 2.5.

    Raises:
        NameError: the alias names a type that does not exist at run time.
    """
    # By name: Python 3.11 has no such class, and typing_extensions has a class of its own in some versions.
    while type(alias := get_origin(type_) or type_).__name__ == "TypeAliasType":
        type_ = _substituted(alias, get_args(type_))
    return type_


def _substituted(alias: Any, arguments: tuple[Any, ...]) -> Any:
    value = alias.__value__
    given = dict(zip(alias.__type_params__, arguments, strict=False))
    if isinstance(value, TypeVar):
        return given.get(value, value)
    parameters = getattr(value, "__parameters__", ())
    # The alias may use its parameters in another order, more than once, or not at all.
    return value[tuple(given.get(one, one) for one in parameters)] if arguments and parameters else value
