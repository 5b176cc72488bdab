"""Build hook: the message classes are generated from proto/ whenever the package is built or installed."""

from __future__ import annotations

import importlib.resources
import re
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parent
OUTPUT = ROOT / "src" / "afspm" / "wire" / "generated"


class ProtoBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Runs protoc over proto/*.proto into afspm.wire.generated."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if self.target_name != "wheel":
            return
        generate(ROOT / "proto", OUTPUT)


def generate(proto_dir: Path, output: Path) -> None:
    """Compile every .proto of `proto_dir` into Python modules and stubs in the package `output`."""
    from grpc_tools import protoc

    output.mkdir(parents=True, exist_ok=True)
    for old in output.glob("*_pb2.py*"):
        old.unlink()
    protos = sorted(str(p) for p in proto_dir.glob("*.proto"))
    well_known = importlib.resources.files("grpc_tools") / "_proto"
    arguments = [
        "protoc",
        f"-I{proto_dir}",
        f"-I{well_known}",
        f"--python_out={output}",
        f"--pyi_out={output}",
    ]
    if protoc.main([*arguments, *protos]) != 0:
        raise RuntimeError(f"protoc failed on {protos}")
    # protoc imports siblings as top-level modules: make them relative, so that the package is importable as it is
    for module in [*output.glob("*_pb2.py"), *output.glob("*_pb2.pyi")]:
        text = module.read_text(encoding="utf-8")
        module.write_text(re.sub(r"^import (\w+_pb2)", r"from . import \1", text, flags=re.M), encoding="utf-8")
    (output / "__init__.py").write_text('"""Generated from proto/ by the build: do not edit."""\n', encoding="utf-8")
