"""The names of a door are loaded on first use, without the source text of any module."""

from __future__ import annotations

import os
import py_compile
import subprocess
import sys
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

import afspm
from afspm.basics.lazy import lazily

ALL_NAMES = """
import afspm
assert afspm.__file__.endswith(".pyc"), afspm.__file__
from afspm import Region
from afspm.basics import *
from afspm.model import *
"""


def test_doors_load_their_names_from_an_installation_of_compiled_files(tmp_path: Path) -> None:
    source = Path(afspm.__file__).parent
    for file in (source / "__init__.py", *(source / "basics").rglob("*.py"), *(source / "model").rglob("*.py")):
        py_compile.compile(str(file), str(tmp_path / "afspm" / file.relative_to(source).with_suffix(".pyc")))
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", ALL_NAMES], env=environment, check=True, timeout=DEADLINE_S)


def test_unknown_name_is_an_attribute_error_that_names_the_package() -> None:
    with pytest.raises(AttributeError, match=r"module 'afspm\.model' has no attribute 'Regoin'"):
        lazily("afspm.model", {"afspm.model.scan": "Region"})("Regoin")
