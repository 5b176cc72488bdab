"""An archive for electronic lab notebooks (.eln): the run as one experiment, with its files.

The format of the ELN Consortium (eLabFTW, Kadi4Mat, PASTA, RSpace, SampleDB …): a zip with one folder, described by an
RO-Crate 1.1 in `ro-crate-metadata.json`. The extracted folder of the run can be opened by `afspm.open_run`.
"""

from __future__ import annotations

import hashlib
import io
import json
import mimetypes
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import IO, Final

from afspm.basics.clock import iso_utc
from afspm.basics.formatting import counted
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.record import journal
from afspm.record.nexus_writer import afspm_version
from afspm.record.run_json import EXPERIMENT_FILE, RUN_FILE
from afspm.report.export import unreadable
from afspm.report.night_report import REPORT_FILE

Node = dict[str, object]

DESCRIPTION_FILE: Final = "ro-crate-metadata.json"
_LICENSE: Final = {
    "@id": "#license",
    "@type": "CreativeWork",
    "name": "No licence stated",
    "description": "The owner of the data has not stated under which licence it may be used.",
}
_DESCRIPTIONS: Final = {
    EXPERIMENT_FILE: "The experiment file, expanded",
    RUN_FILE: "Facts about the run: clock, metadata, end",
    REPORT_FILE: "The report",
    journal.JOURNAL_FILE: "The journal: an SQLite database of all published packets",
    "log.txt": "The log of all processes",
    "truth.jsonl": "Ground truth of the simulated microscope",
}
_TYPES: Final = {".h5": "application/x-hdf5", ".toml": "application/toml", ".sqlite": "application/vnd.sqlite3"}
_ROOT_FILES: Final = (".toml", ".json", ".html", ".txt", ".csv", ".png", ".jsonl")


def archive(run: Run, scans: Sequence[ScanRow], spectra: Sequence[SpectrumRow], folder: Path) -> Iterator[Path]:
    """Write the archive and yield its path. Files are streamed, since a night may be larger than memory.

    Raises:
        OSError: a file can't be read or written.
    """
    name = run.folder.name + (".SIMULATED" if run.simulated else "")
    path = folder / f"{name}.eln"
    partial = path.with_suffix(".eln.part")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as container:
            files = list(_add_files(container, run, name, [*scans, *spectra]))
            graph = _graph(run, name, files, scans, spectra)
            crate = {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph}
            container.writestr(f"{name}/{DESCRIPTION_FILE}", json.dumps(crate, ensure_ascii=False, indent=1))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    yield path


def _add_files(
    container: zipfile.ZipFile, run: Run, name: str, rows: Sequence[ScanRow | SpectrumRow]
) -> Iterator[Node]:
    measured = {row.file: row for row in rows}
    beside = sorted(file for file in run.folder.iterdir() if file.is_file() and file.suffix in _ROOT_FILES)
    for file in [*(one.name for one in beside), *measured]:
        with journal.measured_file(run.folder, file).open("rb") as source:
            yield _add(container, name, run, file, source, _described(file, measured))
    # a copy that is consistent also while the run goes on
    with closing(journal.open_to_read(run.folder)) as database:
        content = database.serialize()
    yield _add(container, name, run, journal.JOURNAL_FILE, io.BytesIO(content), _described(journal.JOURNAL_FILE, {}))


def _add(container: zipfile.ZipFile, name: str, run: Run, file: str, source: IO[bytes], described: str) -> Node:
    digest = hashlib.sha256()
    # sizes above 2 GiB are not known to fit when the entry is begun
    with container.open(f"{name}/{run.folder.name}/{file}", "w", force_zip64=True) as target:
        while block := source.read(1 << 20):
            digest.update(block)
            target.write(block)
    return _file_node(run, file, source.tell(), digest.hexdigest(), described)


def _described(file: str, measured: Mapping[str, ScanRow | SpectrumRow]) -> str:
    row = measured.get(file)
    if row is None:
        return _DESCRIPTIONS.get(file, "Written during the run")
    end = f"finished {iso_utc(row.time_ns)}"
    key = f", key {row.key}" if row.key else ""
    if isinstance(row, SpectrumRow):
        return f"Spectrum {row.number}{key}: {row.kind}, {end}"
    interrupted = ", interrupted" if row.interrupted else ""
    return f"Scan {row.number}{key}: {', '.join(channel for channel, _ in row.channels)}{interrupted}, {end}"


def _file_node(run: Run, file: str, size: int, digest: str, described: str) -> Node:
    suffix = Path(file).suffix
    return {
        "@id": f"./{run.folder.name}/{file}",
        "@type": "File",
        "name": file,
        "description": described,
        "encodingFormat": _TYPES.get(suffix) or mimetypes.guess_type(file)[0] or "application/octet-stream",
        "contentSize": str(size),
        "sha256": digest,
    }


def _graph(
    run: Run, name: str, files: Sequence[Node], scans: Sequence[ScanRow], spectra: Sequence[SpectrumRow]
) -> list[Node]:
    metadata = run.metadata
    began, ended = _began_and_ended(run, [*scans, *spectra])
    description = _description(run, len(scans), len(spectra))
    experiment = f"./{run.folder.name}/"
    person = _person(metadata)
    instrument = _instrument(run, metadata)
    by: Node = {"author": {"@id": person["@id"]}} if person else {}
    keywords = ["scanning probe microscopy", *(metadata.get(one, "") for one in ("technique", "sample", "project"))]
    action: Node = {
        "@id": "#measurement",
        "@type": "CreateAction",
        "name": f"Measurement of {run.name}",
        "startTime": began,
        "endTime": ended,
        "instrument": {"@id": instrument["@id"]},
        "result": {"@id": experiment},
        **({"agent": {"@id": person["@id"]}} if person else {}),
    }
    return [
        {
            "@id": DESCRIPTION_FILE,
            "@type": "CreativeWork",
            "about": {"@id": "./"},
            "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
            "dateCreated": _now(),
            "version": "1.0",
            "sdPublisher": {"@id": "#afspm"},
        },
        {
            "@id": "./",
            "@type": "Dataset",
            "name": name,
            "description": description,
            "datePublished": _now(),
            "license": {"@id": _LICENSE["@id"]},
            "hasPart": [{"@id": experiment}],
            "mentions": {"@id": action["@id"]},
            **by,
        },
        {
            "@id": experiment,
            "@type": "Dataset",
            "name": f"{run.name}{' (SIMULATED)' if run.simulated else ''}",
            "description": description,
            "text": _text(run, description),
            "dateCreated": began,
            "dateModified": ended,
            "identifier": str(run.facts.get("run") or run.folder.name),
            "keywords": ", ".join(word for word in keywords if word),
            "genre": "experiment",
            "hasPart": [{"@id": file["@id"]} for file in files],
            **by,
        },
        *files,
        action,
        instrument,
        *([person] if person else []),
        {"@id": "#afspm", "@type": "SoftwareApplication", "name": "afspm", "version": afspm_version()},
        dict(_LICENSE),
    ]


def _began_and_ended(run: Run, rows: Sequence[ScanRow | SpectrumRow]) -> tuple[str, str]:
    times_ns = [row.began_ns or row.time_ns for row in rows]
    return iso_utc(min(times_ns, default=run.newest_ns)), iso_utc(run.newest_ns)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _description(run: Run, scan_count: int, spectrum_count: int) -> str:
    simulated = "SIMULATED: no real microscope took part. " if run.simulated else ""
    sample = f" of {run.metadata['sample']}" if run.metadata.get("sample") else ""
    scans, spectra = counted(scan_count, "scan"), counted(spectrum_count, "spectrum", "spectra")
    return f"{simulated}{scans} and {spectra}{sample}, measured by the experiment {run.name}."


def _text(run: Run, description: str) -> str:
    # HTML, which notebooks show
    facts = {
        "Ended": str(run.facts.get("ended") or "not ended"),
        **{k.capitalize(): v for k, v in run.metadata.items()},
    }
    # the journal in the archive still names these files
    lost = [row.file for row in (*run.scans, *run.spectra) if row.file and unreadable(run, row) is not None]
    missing = "".join(f"<li>{escape(file)}</li>" for file in lost)
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts.items())
    notes = "".join(f"<li>{iso_utc(note.time_ns)}, {escape(note.who)}: {escape(note.text)}</li>" for note in run.notes)
    listed = f"<h2>Notes</h2><ul>{notes}</ul>" if notes else ""
    gaps = f"<h2>Files that could not be read, and are missing here</h2><ul>{missing}</ul>" if missing else ""
    return f"<p>{escape(description)}</p><table>{rows}</table>{gaps}{listed}"


def _person(metadata: Mapping[str, str]) -> Node | None:
    if not metadata.get("person"):
        return None
    given, _, family = metadata["person"].rpartition(" ")
    names: Node = {"givenName": given, "familyName": family} if given else {}
    return {"@id": metadata.get("orcid") or "#person", "@type": "Person", "name": metadata["person"], **names}


def _instrument(run: Run, metadata: Mapping[str, str]) -> Node:
    model = metadata.get("microscope") or metadata.get("software") or "scanning probe microscope"
    vendor: Node = {"manufacturer": metadata["vendor"]} if metadata.get("vendor") else {}
    simulated = "Simulated " if run.simulated else ""
    return {"@id": "#microscope", "@type": "IndividualProduct", "name": f"{simulated}{model}", **vendor}
