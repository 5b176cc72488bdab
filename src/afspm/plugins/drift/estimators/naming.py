"""Lookup of estimators and trackers by name: afspm's own, and a user's classes as "module.Name"."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Iterable

from afspm.basics import (
    AfspmError,
    ConfigError,
    PlainMapping,
    import_named,
    load_plugin,
    plugin_names,
    require,
    require_trusted,
)


def named(what: str, spec: str | PlainMapping, default: str, *arguments: object) -> tuple[object, str]:
    """Return an estimator or tracker specified by a user's setting, and its name.

    Args:
        what: "estimator" or "tracker".
        spec: a name declared by a package, or "module.Name"; or a table with such a name as its `class` and with the
            settings.
        default: name if the table has no `class`.
        arguments: positional arguments of the constructor, before the settings.

    Raises:
        ConfigError: no such name, class or setting, a meaningless setting, or a missing library.
    """
    settings = {"class": spec} if isinstance(spec, str) else dict(spec)
    name = settings.pop("class", default)
    if not isinstance(name, str):
        raise ConfigError(f"{_a(what)} must be a text, not {name!r}", where="class")
    found = _imported(what, name) if "." in name else _declared(what, name)
    require(found)
    _check_settings(what, name, found, settings, len(arguments))
    try:
        return found(*arguments, **settings), name
    except AfspmError as error:
        where = f"{name}: {error.where}" if error.where else name
        raise ConfigError(error.what, where=where, hint=error.hint) from error
    except Exception as error:  # the constructor may be a user's own code, and raise anything
        raise ConfigError(f"the {what} {name} can't be made with these settings: {error}") from error


def _imported(what: str, name: str) -> type[object]:
    module_name, _, class_name = name.rpartition(".")
    try:
        module = import_named(module_name)
    except ImportError as error:
        hint = "is it installed, or on the path?"
        raise ConfigError(f"the {what} {name} can't be imported: {error}", hint=hint) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise ConfigError(f"the module {module_name} has no class {class_name}", hint=_near(class_name, vars(module)))
    require_trusted(found, name)
    return found


def _declared(what: str, name: str) -> type[object]:
    found = load_plugin(f"afspm.{what}s", name)
    if not isinstance(found, type):
        known = plugin_names(f"afspm.{what}s")
        hint = _near(name.casefold(), known) or f"known: {', '.join(known)}; name one of your own as module.Name"
        raise ConfigError(f"there is no {what} {name!r}", hint=hint)
    return found


def _check_settings(what: str, name: str, class_: type[object], settings: PlainMapping, given: int) -> None:
    # settings are checked before the constructor runs, so that a typo gives its own error
    try:
        parameters = list(inspect.signature(class_).parameters.values())[given:]
    except ValueError:  # C extensions may have no signature
        return
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return
    known = [p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.POSITIONAL_ONLY)]
    for key in settings:
        if key not in known:
            hint = _near(key, known) or f"it takes {', '.join(known) or 'none'}"
            raise ConfigError(f"the {what} {name} has no setting {key!r}", where=key, hint=hint)


def _near(name: str, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(names), n=1)
    return f"did you mean {close[0]!r}?" if close else ""


def _a(what: str) -> str:
    return f"an {what}" if what[0] in "aeiou" else f"a {what}"
