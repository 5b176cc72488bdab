"""Estimators by name, and users' own.

estimator("least-squares")
estimator({"class": "sift", "transform": "affine"})
estimator({"class": "my_lab.Periodicity", "lattice_m": 2.5e-10})
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from afspm.drift.estimators.guarded import Guarded
from afspm.drift.registration import Estimator
from afspm.errors import AfspmError, ConfigError

__all__ = ["DEFAULT", "READY_MADE", "Guarded", "ReadyMade", "estimator"]


@dataclass(frozen=True)
class ReadyMade:
    """An estimator that has a name.

    Attributes:
        path: its class, "module.Name".
        library: what it needs besides numpy.
        extra: of afspm, which installs that.
    """

    path: str
    library: str = "scipy"
    extra: str = "drift"


DEFAULT = "least-squares"

READY_MADE: Mapping[str, ReadyMade] = {
    DEFAULT: ReadyMade("afspm.drift.estimators.least_squares.LeastSquares"),
    "brief": ReadyMade("afspm.drift.estimators.features.Brief", "skimage", "features"),
    "orb": ReadyMade("afspm.drift.estimators.features.Orb", "skimage", "features"),
    "sift": ReadyMade("afspm.drift.estimators.features.Sift", "skimage", "features"),
    "correlation": ReadyMade("afspm.drift.estimators.correlation.Correlation"),
}


def estimator(spec: str | Mapping[str, Any] | Estimator = DEFAULT) -> Estimator:
    """The estimator that is meant, guarded: it refuses where it would have raised or told nonsense.

    Args:
        spec: a name of `READY_MADE` or "module.Name"; a table with that as its `class` and the settings of it (only
            `class` names code); or an estimator.

    Raises:
        ConfigError: no such name, class or setting, a setting without a meaning, or a library that is missing.
    """
    if isinstance(spec, Guarded):
        return spec
    if isinstance(spec, str):
        spec = {"class": spec}
    if not isinstance(spec, Mapping):
        return _guarded(spec, type(spec).__name__)
    settings = dict(spec)
    name = settings.pop("class", DEFAULT)
    if not isinstance(name, str):
        raise ConfigError(f"an estimator is named by a text, not {name!r}", where="class")
    return _guarded(_made(_class(name), settings, name), name)


def _guarded(made: object, name: str) -> Estimator:
    if not callable(getattr(made, "register", None)):
        raise ConfigError(
            f"{name} is no estimator", hint="it needs register(reference, scan, prior), see afspm.drift.registration"
        )
    return Guarded(made, name)  # type: ignore[arg-type]


def _class(name: str) -> type[Any]:
    if "." not in name:
        return _ready_made(name)
    module_name, _, class_name = name.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        hint = "is it installed, or on the path?"
        raise ConfigError(f"the estimator {name} can't be imported: {error}", hint=hint) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise ConfigError(f"the module {module_name} has no class {class_name}", hint=_near(class_name, vars(module)))
    return found


def _ready_made(name: str) -> type[Any]:
    if name not in READY_MADE:
        known = ", ".join(READY_MADE)
        hint = _near(name.casefold(), READY_MADE) or f"there are {known}; write one of your own as module.Name"
        raise ConfigError(f"there is no estimator {name!r}", hint=hint)
    entry = READY_MADE[name]
    if importlib.util.find_spec(entry.library) is None:
        raise ConfigError(f"the estimator {name!r} needs {entry.library}", hint=f'pip install "afspm[{entry.extra}]"')
    module_name, _, class_name = entry.path.rpartition(".")
    found: type[Any] = getattr(importlib.import_module(module_name), class_name)
    return found


def _made(class_: type[Any], settings: dict[str, Any], name: str) -> object:
    """Settings are looked at first, so that a typo is told as one."""
    try:
        parameters: Mapping[str, inspect.Parameter] = inspect.signature(class_).parameters
    except ValueError:  # a class of C code without a signature
        parameters = {}
    named = [n for n, p in parameters.items() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD, p.POSITIONAL_ONLY)]
    if parameters and all(p.kind is not p.VAR_KEYWORD for p in parameters.values()):
        for key in settings:
            if key not in named:
                hint = _near(key, named) or f"it takes {', '.join(named) or 'none'}"
                raise ConfigError(f"the estimator {name} has no setting {key!r}", where=key, hint=hint)
    try:
        made: object = class_(**settings)
    except AfspmError as error:
        where = f"{name}: {error.where}" if error.where else name
        raise ConfigError(error.what, where=where, hint=error.hint) from error
    except Exception as error:  # anybody's constructor
        raise ConfigError(f"the estimator {name} can't be made with these settings: {error}") from error
    return made


def _near(name: str, names: Mapping[str, Any] | list[str]) -> str:
    close = difflib.get_close_matches(name, list(names), n=1)
    return f"did you mean {close[0]!r}?" if close else ""
