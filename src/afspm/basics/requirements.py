"""Check of the packages that a class needs beyond a plain install of afspm: its attribute `requires`.

    class Ridges(Component):
        requires = ("afspm[features]", "torch>=2.4")

`afspm check` and `afspm run` report missing packages before anything starts. Only the metadata of installed packages is
read, so a check imports no large package. A table in afspm would not know the classes of other packages. A caught
ImportError appears first when the class runs, in the worst case at the end of the night.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from afspm.basics.errors import ConfigError

ATTRIBUTE = "requires"


def require(class_: object) -> None:
    """Check that the packages a class requires are installed.

    Raises:
        ConfigError: a package is missing or has another version, with the command that installs it as the hint; or a
            requirement is malformed.
    """
    wanted = getattr(class_, ATTRIBUTE, ())
    require_installed(getattr(class_, "__name__", str(class_)), *((wanted,) if isinstance(wanted, str) else wanted))


def require_installed(what: str, *requirements: str) -> None:
    """Check that the packages required by `what` are installed. Raises ConfigError as `require` does."""
    lacking = {one: missing for one in requirements if (missing := list(_missing(one)))}
    if lacking:
        packages = ", ".join(dict.fromkeys(package for missing in lacking.values() for package in missing))
        command = "pip install " + " ".join(f'"{one}"' for one in lacking)
        raise ConfigError(f"{what} needs packages that are not installed: {packages}", hint=command)


@contextmanager
def imports_of_extra(extra: str, what: str) -> Iterator[None]:
    """Import packages of an extra of afspm, needed by `what`, within this context.

    Raises:
        ConfigError: a package is not installed, with the command that installs the extra as the hint.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        hint = f'pip install "afspm[{extra}]"'
        raise ConfigError(f"{what} needs {error.name}, which is not installed", hint=hint) from None


def _missing(requirement: str) -> Iterator[str]:
    # packages of extras too: metadata lists them as requirements with a marker
    from importlib import metadata  # imported late, as is `packaging`: few classes require anything

    from packaging.requirements import InvalidRequirement, Requirement

    try:
        wanted = Requirement(requirement)
        version = metadata.version(wanted.name)
    except InvalidRequirement as error:
        raise ConfigError(f"requires: {requirement!r} is not a requirement", hint='e.g. "scipy>=1.13"') from error
    except metadata.PackageNotFoundError:
        yield wanted.name
        return
    if not wanted.specifier.contains(version, prereleases=True):
        yield f"{wanted.name}{wanted.specifier} (there is {version})"
    for text in metadata.requires(wanted.name) or () if wanted.extras else ():
        of_extra = Requirement(text)
        marker, of_extra.marker = of_extra.marker, None
        if marker and any(marker.evaluate({"extra": extra}) for extra in wanted.extras):
            yield from _missing(str(of_extra))
