"""Settings of a component: checked against its constructor (names, types, units), in SI, before anything starts."""

from __future__ import annotations

import contextlib
import inspect
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from datetime import date, datetime
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import pydantic

from afspm.basics import units
from afspm.basics.addresses import Listens
from afspm.basics.errors import UnitError
from afspm.basics.type_aliases import unaliased
from afspm.experiment import class_loader
from afspm.experiment.document import Document
from afspm.experiment.findings import closest, nearest
from afspm.experiment.toml_lines import Settings, Table
from afspm.experiment.validation_messages import report
from afspm.model.channels import NamesChannel
from afspm.model.variables import HEIGHT

# units of the annotations in basics.units, tried in this order
_ANNOTATED = ("m", "s", "rad", "V", "A", "m/s", "Hz")
_KINDS_WITHOUT_NAME = {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD}
_TYPES = pydantic.ConfigDict(arbitrary_types_allowed=True)


def resolve(
    component: type,
    settings: Table,
    path: tuple[str, ...],
    document: Document,
    given: Collection[str] = (),
    wrong: set[str] | None = None,
) -> Settings:
    """Return the settings for the process: validated, in SI units, of JSON's types; report errors.

    Args:
        given: parameters that the table must not set.
        wrong: set to which the names of settings with errors are added.
    """
    everything = _parameters(component)
    parameters = {name: p for name, p in everything.items() if p.kind not in _KINDS_WITHOUT_NAME and name not in given}
    takes_any = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in everything.values())
    kinds = _annotations(component)
    checked: Settings = {}
    unknown: list[str] = []
    for name, value in settings.items():
        if name in parameters:
            annotation = kinds.get(name, Any)
            if name not in kinds and _is_quantity(value):
                what = f"[{'.'.join(path)}] {name} = {value!r} stays a text: the argument has no annotation with a unit"
                hint = f"e.g. `def __init__(self, {name}: Length)`, with Length from afspm.basics.units"
                document.warning(what, *path, name, hint=hint)
            errors = document.findings.errors
            checked[name] = _value(annotation, value, (*path, name), document)
            if wrong is not None and document.findings.errors > errors:
                wrong.add(name)
        elif takes_any:
            checked[name] = jsonable(value, document.folder_of(*path, name))
        else:
            unknown.append(name)
            replaced = "" if closest(name, parameters) else _replaced_class_hint(path, name, document)
            what = f"[{'.'.join(path)}] has no setting {name!r}"
            hint = replaced or nearest(name, parameters) or f"the class {component.__name__} has no settings"
            document.error(what, *path, name, hint=hint)
    _report_missing(parameters, settings, unknown, path, document)
    return checked


def _replaced_class_hint(path: tuple[str, ...], name: str, document: Document) -> str:
    # a later file that changes the class alone leaves behind settings that only the earlier class had
    of_class, of_setting = document.place(*path, "class").file, document.place(*path, name).file
    if document.files.index(Path(of_class)) <= document.files.index(Path(of_setting)):
        return ""
    return f"the class is set in {of_class}: move settings of the replaced class into an overlay for that class"


def default_of(component: type, name: str) -> Any:
    """Return the default of a setting; None if there is no default."""
    parameter = _parameters(component).get(name)
    return None if parameter is None or parameter.default is inspect.Parameter.empty else parameter.default


def choices(component: type) -> dict[str, tuple[object, ...]]:
    """Return the words that each setting of a component can have, if it has a choice of words."""
    literal: object = typing.Literal
    return {
        name: typing.get_args(annotation)
        for name, annotation in _annotations(component).items()
        if typing.get_origin(annotation) is literal
    }


def listening(component: type, settings: Table) -> Iterator[tuple[str, str, bool]]:
    """Yield (setting, address, True if guarded by keys) of each socket that a component binds by its settings."""
    everything = {**{name: default_of(component, name) for name in _parameters(component)}, **settings}
    for name, annotation in _annotations(component).items():
        for mark in getattr(annotation, "__metadata__", ()):
            if not isinstance(mark, Listens):
                continue
            if (address := mark.address(everything.get(name), everything)) is not None:
                yield name, address, mark.keyed


def channels(component: type, settings: Table) -> Iterator[tuple[tuple[str, ...], str, bool]]:
    """Yield each channel that a component needs: its path in the settings, its role or name, True if of heights."""
    everything = {**{name: default_of(component, name) for name in _parameters(component)}, **settings}
    for name, annotation in _annotations(component).items():
        value = everything.get(name)
        if (mark := _channel_mark(annotation)) is not None and isinstance(value, str):
            yield (name,), value, mark
        elif isinstance(value, Mapping) and (inner := _dataclass_of(annotation)) is not None:
            for key, kind in typing.get_type_hints(inner, include_extras=True).items():
                if (mark := _channel_mark(kind)) is not None and isinstance(value.get(key), str):
                    yield (name, key), value[key], mark


def _channel_mark(annotation: Any) -> bool | None:
    # whether a channel is one of heights; None for another setting
    marks = getattr(annotation, "__metadata__", ())
    if any(isinstance(mark, NamesChannel) for mark in marks):
        return HEIGHT in marks
    inside = map(_channel_mark, typing.get_args(annotation))
    return next((mark for mark in inside if mark is not None), None)


def _dataclass_of(annotation: Any) -> type | None:
    kinds = (annotation, *typing.get_args(annotation))
    return next((kind for kind in kinds if isinstance(kind, type) and is_dataclass(kind)), None)


def jsonable(value: object, folder: Path) -> Any:
    """Return `value` in JSON's types; a relative path is resolved against the experiment file's folder."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value if value.is_absolute() else folder / value)
    if is_dataclass(value) and not isinstance(value, type):
        return jsonable(asdict(value), folder)
    if isinstance(value, Mapping):
        return {str(key): jsonable(item, folder) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(item, folder) for item in value]
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, str) and value.startswith(("./", "../")):
        return str((folder / value).resolve())  # a path within a table without types is recognised only here
    return value


def _value(annotation: Any, value: Any, path: tuple[str, ...], document: Document) -> object:
    folder = document.folder_of(*path)
    if _is_object(value):
        return _user_intermediary(value, path, document)
    if isinstance(value, list) and any(map(_is_object, value)):
        return [_value(Any, item, path, document) for item in value]
    if annotation is bool:
        annotation = pydantic.StrictBool  # pydantic would accept "yes" and 1 as true
    try:
        adapter = pydantic.TypeAdapter(annotation, config=None if _has_own_config(annotation) else _TYPES)
    except pydantic.PydanticUndefinedAnnotation:
        return jsonable(value, folder)
    try:
        return jsonable(adapter.validate_python(value), folder)
    except pydantic.ValidationError as error:
        report(error, value, path, document)
        return jsonable(value, folder)


def _user_intermediary(value: Settings, path: tuple[str, ...], document: Document) -> Settings:
    # an intermediary class of the user's is checked here, and made in its process
    settings = {key: item for key, item in value.items() if key != "class"}
    try:
        wanted = class_loader.load(value["class"])
    except class_loader.Unloadable as error:
        document.error(f"[{path[0]}] {'.'.join(path[1:])} class: {error.what}", *path, hint=error.hint)
        return {"class": value["class"]}
    if not isinstance(wanted, type):
        document.error(f"[{path[0]}] {'.'.join(path[1:])}: {value['class']} is not a class", *path)
        return {"class": value["class"]}
    return {"class": value["class"], **resolve(wanted, settings, path, document)}


def _is_quantity(value: object) -> bool:
    if not isinstance(value, str):
        return False
    for unit in _ANNOTATED:
        with contextlib.suppress(UnitError):
            units.convert(*units.parse_quantity(value), unit)
            return True
    return False


def _is_object(value: object) -> bool:
    return isinstance(value, dict) and isinstance(value.get("class"), str)


def _has_own_config(annotation: object) -> bool:
    inner = typing.get_origin(annotation) or annotation
    return isinstance(inner, type) and (
        is_dataclass(inner) or issubclass(inner, pydantic.BaseModel) or typing.is_typeddict(inner)
    )


@cache
def _parameters(component: type) -> Mapping[str, inspect.Parameter]:
    parameters: dict[str, inspect.Parameter] = {}
    for init in _constructors(component):
        own = list(inspect.signature(init).parameters.values())[1:]  # without self
        parameters = {p.name: p for p in own if p.name not in parameters} | parameters
        parameters = {n: p for n, p in parameters.items() if p.kind is not inspect.Parameter.VAR_KEYWORD or p in own}
    return parameters


@cache
def _constructors(component: type) -> Sequence[Callable[..., object]]:
    chain: list[Callable[..., object]] = []
    for base in component.__mro__:
        init = vars(base).get("__init__")
        if base is object or not inspect.isfunction(init):
            continue
        chain.append(init)
        if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in inspect.signature(init).parameters.values()):
            break
    return chain


@cache
def _annotations(component: type) -> Table:
    # annotations imported under TYPE_CHECKING only can't be resolved, and are left out
    kinds: Settings = {}
    for init in reversed(_constructors(component)):
        try:
            hints = typing.get_type_hints(init, include_extras=True)
            kinds |= {name: unaliased(hint) for name, hint in hints.items()}
        except NameError:
            kinds |= {n: a for n, a in init.__annotations__.items() if not isinstance(a, str)}
    return kinds


def _report_missing(
    parameters: Mapping[str, inspect.Parameter],
    settings: Table,
    unknown: list[str],
    path: tuple[str, ...],
    document: Document,
) -> None:
    for name, parameter in parameters.items():
        if parameter.default is not inspect.Parameter.empty or name in settings:
            continue
        if closest(name, unknown, 0.7):
            continue  # missing because misspelt: reported already
        document.error(f"[{'.'.join(path)}] needs the setting {name!r}", *path)
