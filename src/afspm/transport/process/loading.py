"""Loading of the class in a launch line, and its construction with the settings."""

from __future__ import annotations

import difflib
import inspect

from afspm.basics import named_imports
from afspm.basics.errors import AfspmError, ConfigError
from afspm.basics.launch import Launch
from afspm.transport.process.context import ExperimentProcess


def load(launch: Launch) -> ExperimentProcess:
    """Return the component, scheduler or translator of a launch line.

    Raises:
        ConfigError: the class does not exist, or can't be constructed with these settings. A restart would not help.
    """
    class_ = find_class(launch.class_, launch.name, of_process=True)
    if not hasattr(class_, "run_process"):  # before it is constructed: a record may name any class, of any effect
        raise _not_a_process(launch)
    _check_settings(class_, launch)
    try:
        plain = getattr(class_, "plain_settings", ())  # tables whose `class` the class handles itself
        made = class_(
            **{name: value if name in plain else made_of(value, launch.name) for name, value in launch.settings.items()}
        )
    except AfspmError as error:
        where = f"{launch.name}: {error.where}" if error.where else launch.name
        raise ConfigError(error.what, where=where, hint=error.hint) from error
    if not isinstance(made, ExperimentProcess):
        raise _not_a_process(launch)
    return made


def _not_a_process(launch: Launch) -> ConfigError:
    return ConfigError(f"{launch.class_} can't be run", where=launch.name, hint="derive it from afspm.Component")


def made_of(value: object, where: str) -> object:
    """Return a setting in which each table with a `class` is replaced by the object constructed from the table.

    Raises:
        ConfigError: there is no such class.
    """
    if isinstance(value, list | tuple):
        return [made_of(item, where) for item in value]
    if not isinstance(value, dict):
        return value
    inside = {key: made_of(item, where) for key, item in value.items()}
    path = inside.pop("class", None)
    if isinstance(path, str):
        return find_class(path, where)(**inside)
    return inside if path is None else {"class": path, **inside}


def find_class(path: str, where: str, *, of_process: bool = False) -> type[object]:
    """Return the class "package.module.Name".

    Args:
        of_process: the class of a process, rather than of an object in its settings.

    Raises:
        ConfigError: there is no such class, or its module is not trusted.
    """
    class_ = find_object(path, where, "class", of_process=of_process)
    if not isinstance(class_, type):
        raise ConfigError(f"{path} is not a class", where=where)
    return class_


def find_object(path: str, where: str, what: str = "function", *, of_process: bool = False) -> object:
    """Return the object "package.module.name".

    Args:
        what: kind of the object, for the error.

    Raises:
        ConfigError: there is no such object, or its module is not trusted.
    """
    module_name, _, name = path.rpartition(".")
    if not module_name:
        raise ConfigError(f"{path!r} names no {what}", where=where, hint=f'write {what} = "module.name"')
    try:
        module = named_imports.import_named(module_name, of_process=of_process)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the {what} {path} can't be imported: {error}", where=where, hint="is it installed, or on the path?"
        ) from error
    found = getattr(module, name, None)
    if found is None:
        near = difflib.get_close_matches(name, vars(module), n=1)
        raise ConfigError(
            f"the module {module_name} has no {what} {name}",
            where=where,
            hint=f"did you mean {near[0]!r}?" if near else "",
        )
    if not of_process:
        named_imports.require_trusted(found, path)
    return found


def _check_settings(class_: type[object], launch: Launch) -> None:
    # before the call, so that a misspelt setting is no TypeError from inside a constructor
    try:
        signature = inspect.signature(class_)
        signature.bind(**launch.settings)
    except ValueError:
        return  # a class in C without a signature can't be checked
    except TypeError as error:
        names = [name for name in signature.parameters if name not in ("args", "kwargs")]
        raise ConfigError(
            f"{launch.class_} can't be made with these settings: {error}",
            where=launch.name,
            hint=f"it takes {', '.join(names) or 'none'}",
        ) from error
