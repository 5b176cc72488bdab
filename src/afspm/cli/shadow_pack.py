"""A shadow's run as a folder for others: raw values, wire trace and table, without names, comments and places of files.

**Theory of operation.** Private texts are found first, and shown to the person: the facts of [metadata], the user and
the computer, folders and names of the controller's files, and the entries of their headers that a person writes. Each
of these texts is then replaced in everything that goes into the folder, by letters x of the same length, so that
lengths in messages and offsets in files stay as they are, and the trace can be played back. At last every file of the
folder is searched once more. Journal, log, notes, experiment file and saved state are not packed at all.
"""

from __future__ import annotations

import getpass
import io
import json
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final

import numpy as np

from afspm.basics.errors import AfspmError, FileError, InvalidValue
from afspm.night.run import Run
from afspm.record.run_json import COMPUTER
from afspm.report import shadow_report as shadow
from afspm.report.export.netcdf import scan_file
from afspm.report.markup import PageTimes, document, section
from afspm.storage import formats
from afspm.translator.trace import (
    FILE,
    TracedExchange,
    TracedFile,
    TraceHeader,
    TraceLine,
    load_of,
    trace_lines,
    written_line,
)

TRACE_FILE: Final = FILE
_WRITTEN_BY_PEOPLE: Final = re.compile(
    "comment|user|operator|author|title|sample|person|memo|note|host|path|file|folder|director|session|basename"
    "|experiment|project|orcid|^run$",
    re.IGNORECASE,
)
"""Names of entries in a file's header whose texts are private."""
_FOLDER: Final = re.compile(
    rb"(?<![A-Za-z0-9+/=])"
    rb"(?:(?:[A-Za-z]:(?:\\\\?|/)|/)(?:[^\\/\0-\x1f\"<>|*?:]{2,100}(?:\\\\?|/)+)+|[A-Z]:(?:[\w -]{2,100}:)+)"
)
"""A folder in a text: of Windows, of other systems, or of Igor; backslashes may be doubled, as in JSON."""
_WHOLE_FOLDER: Final = re.compile(_FOLDER.pattern + rb"[^\\/.:\0-\x1f]{1,100}")
_TEXT_IN_BINARY: Final = re.compile(rb"(?=(\0\0[\0-\x0f][\0-\xff])[\x20-\x7e])", re.DOTALL)
"""The length of a text in a binary message, and its place."""
_PRINTABLE: Final = re.compile(rb"[\t\n\r\x20-\x7e\x80-\xff]*")
_LONG: Final = 6
"""Shorter texts may be found in binary values by chance: there they are replaced within a printable text only."""
_COUNTER: Final = re.compile(r"(.*?)\d{2,}.*")
_LETTERS: Final = re.compile(rb"\\u[0-9a-fA-F]{4}|\\.|[A-Za-z0-9\x80-\xff]", re.DOTALL)
_SHORTEST: Final = 3
_ASKED: Final = "--hide"
_HDF5: Final = b"\x89HDF"
LEFT_OUT: Final = "the journal, the log, notes and comments on marks, the experiment file, [metadata], saved state"
KEPT: Final = (
    "shadow.csv and report.html: the shadow's table and its figures",
    "scans/*.nc: channels, units, frame, times and raw values of each scan",
    f"{TRACE_FILE}: every question and answer, and the controller's files, with the replacements above",
    "pack.json: version of afspm, driver, number of scans, agreement, load on the controller",
)


@dataclass(frozen=True)
class PrivateText:
    """A text that is replaced, and the place where it was found.

    Attributes:
        is_start: whether the text may be followed by a number, as a file's name.
    """

    where: str
    text: str
    is_start: bool = False


@dataclass
class ShadowPack:
    """The content of a pack, before it is written.

    Attributes:
        private: the texts to replace.
        too_short: private texts that are not replaced, since they would be found everywhere, with their places.
    """

    run: Run
    night: shadow.ShadowNight
    traces: list[Path]
    private: list[PrivateText]
    too_short: list[PrivateText] = field(default_factory=list)


def read(run: Run, hidden: Iterable[str] = ()) -> ShadowPack:
    """Read a shadow's run, and find the private texts in it.

    Args:
        hidden: more texts to replace.

    Raises:
        InvalidValue: the run is no shadow.
        FileError: the trace can't be read.
    """
    night = shadow.read(run)
    if not night.agreement:
        hint = "`afspm shadow FILE` makes one; `afspm trace` records a run that commands"
        raise InvalidValue(f"the run in {run.folder} is no shadow", hint=hint)
    traces = sorted(run.folder.glob(f"*{FILE}"))
    return ShadowPack(run, night, traces, *replaceable([*_named(hidden), *_private(run, traces)], traces))


def replaceable(texts: Iterable[PrivateText], traces: Iterable[Path]) -> tuple[list[PrivateText], list[PrivateText]]:
    """Return the texts to replace, the longest first, and those too short or part of a word of the protocol."""
    protocol = " ".join({line.what for line in traced(traces) if isinstance(line, TracedExchange)})
    different = {private.text: private for private in reversed(list(texts)) if private.text.strip()}
    replaced, short = list[PrivateText](), list[PrivateText]()
    for private in sorted(different.values(), key=lambda private: -len(private.text)):
        is_asked = private.where == _ASKED
        too_short = not is_asked and (len(private.text) < _SHORTEST or private.text in protocol)
        (short if too_short else replaced).append(private)
    return replaced, short


def traced(traces: Iterable[Path]) -> Iterator[TraceLine]:
    for file in traces:
        yield from trace_lines(file)


def _named(hidden: Iterable[str]) -> Iterator[PrivateText]:
    yield from (PrivateText(_ASKED, text) for text in hidden)


def _private(run: Run, traces: Iterable[Path]) -> Iterator[PrivateText]:
    for name, value in run.metadata.items():
        if _WRITTEN_BY_PEOPLE.search(name):
            yield PrivateText(f"[metadata] {name}", value)
    yield from of_this_computer(str(run.facts.get(COMPUTER, "")))
    yield PrivateText("the experiment's name", run.name)
    for row in (*run.scans, *run.spectra):
        yield from _of_path("a file of the controller", row.filename)
        if row.file:
            try:
                yield from _of_header(run.about(row))
            except FileError:
                continue  # a measurement whose file is lost is not packed either
    yield from of_trace(traces)


def of_this_computer(name: str) -> Iterator[PrivateText]:
    """Yield the private texts of the user and the computer of this name."""
    yield PrivateText("the user's name here", getpass.getuser())
    yield PrivateText("the user's folder here", str(Path.home()))
    yield PrivateText("the computer's name", name)


def of_trace(traces: Iterable[Path]) -> Iterator[PrivateText]:
    """Yield names, folders and written entries of the controller's files, and folders in its answers."""
    for line in traced(traces):
        if isinstance(line, TracedFile):
            yield from _of_path("a file of the controller", line.file)
            yield from _of_header(_header(line))
        elif isinstance(line, TracedExchange):
            for folder in _folders(line.answered):
                yield PrivateText(f"a folder in the answer to {line.what}", folder)


@lru_cache(maxsize=4096)
def _folders(content: bytes) -> tuple[str, ...]:
    texts = list(_texts(content))
    paths = [text for text in texts if _WHOLE_FOLDER.fullmatch(text)] + [
        path for text in texts for path in _FOLDER.findall(text)
    ]
    folders = (path.decode("utf-8", "replace").replace("\\\\", "\\").rstrip("\\/:") for path in paths)
    return tuple(dict.fromkeys(folders))


def _is_text(content: bytes) -> bool:
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return _PRINTABLE.fullmatch(content) is not None


def _texts(content: bytes) -> Iterator[bytes]:
    if _is_text(content):
        yield content
        return
    for place in _TEXT_IN_BINARY.finditer(content):
        length, begin = int.from_bytes(place[1], "big"), place.end(1)
        text = content[begin : begin + length]
        if len(text) == length and _is_text(text):
            yield text


def _of_path(where: str, name: str) -> Iterator[PrivateText]:
    path = PureWindowsPath(name) if "\\" in name else PurePosixPath(name)
    if str(path.parent) not in (".", path.anchor):
        yield PrivateText(where, str(path.parent))
    counter = _COUNTER.fullmatch(path.stem)
    yield PrivateText(where, counter[1] if counter else path.stem, is_start=True)


def _of_header(header: Mapping[str, Any], above: str = "") -> Iterator[PrivateText]:
    for name, value in header.items():
        if isinstance(value, Mapping):
            yield from _of_header(value, name)
        elif isinstance(value, str) and _WRITTEN_BY_PEOPLE.search(f"{name}"):
            for line in value.splitlines():
                if len(re.findall(r"[^\W\d_]", line)) > 1:
                    yield PrivateText(f"entry {name} of a file", line.strip())


def _header(file: TracedFile) -> Mapping[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / file.file
        path.write_bytes(file.content)
        try:
            return formats.read(path).header
        except AfspmError:
            return {}


class Mask:
    """A replacement of private texts by letters of the same length."""

    def __init__(self, private: Iterable[PrivateText]) -> None:
        plain, escaped, in_binary = list[bytes](), list[bytes](), list[bytes]()
        for hidden in private:
            end = rb"" if hidden.is_start else rb"(?![A-Za-z0-9])"
            start = rb"(?<![A-Za-z0-9])" if hidden.text[:1].isalnum() else rb""
            for form in {hidden.text.encode(), hidden.text.encode("cp1252", "replace")}:
                plain.append(start + re.escape(form) + end)
                length = re.escape(len(form).to_bytes(4, "big"))
                within = rb"" if len(form) >= _LONG else rb"(?:(?<=[\t\n\r\x20-\x7e]{4})|(?<=" + length + rb"))"
                in_binary.append(within + plain[-1])
            once = json.dumps(hidden.text)[1:-1]
            for text in {once, json.dumps(once)[1:-1], json.dumps(hidden.text, ensure_ascii=False)[1:-1]} - {
                hidden.text
            }:
                escaped.append(start + re.escape(text.encode()) + end)
            wide = re.escape(hidden.text.encode("utf-16-le"))
            in_binary += [wide] if len(hidden.text) >= _SHORTEST else []
        self._escaped, self._plain, self._in_binary = _any_of(escaped), _any_of(plain), _any_of(in_binary)

    def of(self, content: bytes) -> bytes:
        """Return the content with each private text replaced."""
        is_text = _is_text(content)
        if is_text and self._escaped is not None:
            content = self._escaped.sub(lambda match: _LETTERS.sub(_letter, match[0]), content)
        pattern = self._plain if is_text else self._in_binary
        return content if pattern is None else pattern.sub(lambda match: _x(match[0]), content)

    def text(self, text: str) -> str:
        return self.of(text.encode()).decode("utf-8", "replace")

    def file(self, content: bytes) -> bytes:
        """Return a file of the controller; strings in HDF5 are written by its library, which has checksums of them."""
        return _masked_hdf5(content, self) if content.startswith(_HDF5) else self.of(content)


def _any_of(patterns: list[bytes]) -> re.Pattern[bytes] | None:
    longest_first = sorted(set(patterns), key=lambda pattern: -len(pattern))
    return re.compile(b"|".join(longest_first), re.IGNORECASE) if patterns else None


def _x(text: bytes) -> bytes:
    return bytes(120 if chr(byte).isalnum() or byte >= 0x80 else byte for byte in text)


def _letter(match: re.Match[bytes]) -> bytes:
    if match[0].startswith(b"\\u"):
        return b"x" * 6
    return match[0] if match[0].startswith(b"\\") else b"x"


def _masked_hdf5(content: bytes, mask: Mask) -> bytes:
    import h5py

    file = io.BytesIO(content)
    with h5py.File(file, "r+") as root:

        def change(_: str, thing: Any) -> None:
            for name, value in list(thing.attrs.items()):
                if (masked := _masked_strings(value, mask)) is not None:
                    thing.attrs.modify(name, masked)
            if (
                isinstance(thing, h5py.Dataset)
                and thing.dtype.kind in "SO"
                and h5py.check_ref_dtype(thing.dtype) is None
            ):
                masked = _masked_strings(thing[()], mask)
                if masked is not None:
                    thing[()] = masked

        change("", root)
        root.visititems(change)
    return file.getvalue()


def _masked_strings(value: Any, mask: Mask) -> Any:
    """Return strings with the replacements; None if nothing is replaced."""
    if isinstance(value, str):
        masked = mask.text(value)
        return masked if masked != value else None
    if isinstance(value, bytes):
        return masked_bytes if (masked_bytes := mask.of(value)) != value else None
    if isinstance(value, np.ndarray) and value.dtype.kind == "S":
        # a text may be an array of single characters
        whole = value.tobytes()
        masked_bytes = mask.of(whole)
        return np.frombuffer(masked_bytes, value.dtype).reshape(value.shape) if masked_bytes != whole else None
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        parts = [_masked_strings(element, mask) for element in value.ravel()]
        if all(part is None for part in parts):
            return None
        pairs = zip(parts, value.ravel(), strict=True)
        return np.array([element if part is None else part for part, element in pairs], object).reshape(value.shape)
    return None


def write(pack: ShadowPack, folder: Path) -> list[str]:
    """Write a pack into a new folder; return what was left out, in words.

    Raises:
        FileError: the folder exists, can't be written, or still has a private text.
    """
    mask, left_out, run = Mask(pack.private), list[str](), pack.run
    try:
        (folder / "scans").mkdir(parents=True)
        night = replace(pack.night, rows=[_without_comment(row) for row in pack.night.rows])
        (folder / shadow.FILE).write_text(mask.text(shadow.csv_text(night)), encoding="utf-8")
        times = PageTimes(run.oldest_ns, run.newest_ns)
        page = document("A shadow", section("What afspm would have done", shadow.html(night, times)))
        (folder / "report.html").write_text(mask.text(page), encoding="utf-8")
        for row in run.scans:
            if not row.file:
                continue
            try:
                values = scan_file(run.scan(row), {}, {"time_ns": row.time_ns, "began_ns": row.began_ns})
            except FileError as error:
                left_out.append(f"scan {row.number}: {error}")
                continue
            (folder / "scans" / f"{row.number:04}.nc").write_bytes(mask.of(values))
        for trace in pack.traces:
            left_out += _write_trace(trace, mask, folder / trace.name)
        (folder / "pack.json").write_text(json.dumps(_facts(pack), indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(folder)) from error
    require_clean(folder, mask)
    return left_out


def _write_trace(trace: Path, mask: Mask, file: Path) -> list[str]:
    left_out = []
    masked = lru_cache(maxsize=4096)(mask.of)
    with file.open("w", encoding="utf-8") as lines:
        for line in trace_lines(trace):
            if isinstance(line, TracedExchange):
                asked = None if line.asked is None else masked(line.asked)
                line = replace(line, asked=asked, answered=masked(line.answered), what=mask.text(line.what))
                line = replace(line, lost=mask.text(line.lost), command=mask.text(line.command))
            elif isinstance(line, TracedFile):
                name = mask.text(line.file)
                masked_file = replace(line, file=name, content=mask.file(line.content))
                if _values(line) is not None and _values(masked_file) != _values(line):
                    left_out.append(f"{name}: its values are not readable after the replacements")
                    masked_file = replace(masked_file, content=b"")
                line = masked_file
            lines.write(written_line(line) + "\n")
    return left_out


def _values(file: TracedFile) -> tuple[bytes, ...] | None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / file.file
        path.write_bytes(file.content)
        try:
            return tuple(measured.values.tobytes() for measured in formats.read(path))
        except AfspmError:
            return None


def _without_comment(row: shadow.ShadowRow) -> shadow.ShadowRow:
    return row if row.mark is None else replace(row, mark=shadow.ShadowMark(row.mark.right))


def _facts(pack: ShadowPack) -> dict[str, object]:
    load = load_of(traced(pack.traces[:1]))
    driver = next((line for line in traced(pack.traces) if isinstance(line, TraceHeader)), TraceHeader("", "", ""))
    return {
        "afspm": driver.afspm,
        "driver": driver.driver,
        "began": driver.began,
        "scans": len(pack.run.scans),
        "interrupted": sum(scan.interrupted for scan in pack.run.scans),
        "agreement": [asdict(agreement) for agreement in pack.night.agreement],
        "load": None if load is None else asdict(load),
    }


def require_clean(folder: Path, mask: Mask) -> None:
    """Raise FileError if a file of a folder still has a private text."""
    for file in sorted(folder.rglob("*")):
        if not file.is_file():
            continue
        if file.name.endswith(TRACE_FILE):
            contents: Iterable[bytes] = (part for line in trace_lines(file) for part in _contents(line))
        else:
            contents = [file.read_bytes()]
        if any(mask.of(content) != content for content in contents):
            raise FileError("still has a private text: don't share this folder", where=str(file))


def _contents(line: TraceLine) -> Iterator[bytes]:
    if isinstance(line, TracedFile):
        yield from (line.file.encode(), line.content)
    elif isinstance(line, TracedExchange):
        yield from (line.asked or b"", line.answered, line.lost.encode())
