"""Builds the documentation as a site in build/site, and checks every link in it.

Run by `make docs`. The pages stay as they are in docs/ and experiments/: they are copied, the files and folders that
they link to become pages of code, and the navigation is what docs/README.md lists.
"""

from __future__ import annotations

import json
import os
import posixpath
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import bootstrap
import drawing_colours

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build"
SOURCE, SITE, ENVIRONMENT = BUILD / "site-source", BUILD / "site", BUILD / "docs-env"
LINK = re.compile(r"(?<!!)\]\((?!\w+:|#)([^)#\s]+)(#[^)]*)?\)")
DRAWING = re.compile(r"!\[([^\]]*)\]\(([^)]+)\.svg\)")
SECTION = re.compile(r"^- \*\*(.+?)\*\*:(.*?)(?=^- \*\*|\Z)", re.MULTILINE | re.DOTALL)
SEARCHES = (
    "adhesion map",
    "thermal drift",
    "tip repair",
    "feedback gain",
    "power cut",
    "force curve",
    "matlab",
    "gwyddion",
)
"""What people look for: a build fails if the search of the site finds nothing for one of them."""
PAGES = (
    "*.md",
    "changes/README.md",
    "docs/**/*.md",
    "experiments/**/*.md",
    "src/**/README.md",
    "clients/*/README.md",
    "packages/*/README.md",
    "packages/*/docs/*.md",
)
FENCES = {".py": "python", ".toml": "toml", ".proto": "protobuf", ".json": "json", ".md": "markdown"}


def main() -> None:
    for folder in (SOURCE, SITE):
        shutil.rmtree(folder, ignore_errors=True)
    prepare(ROOT, SOURCE, BUILD / "zensical.toml")
    _zensical()
    broken = sorted(set(_broken_links()))
    if broken:
        sys.exit("\n".join([*broken, f"{len(broken)} broken links"]))
    index = json.loads((SITE / "search.json").read_text(encoding="utf-8"))["items"]
    if missed := unfound(index, SEARCHES):
        sys.exit(f"the search finds nothing for: {', '.join(missed)}")
    sys.stdout.write(f"{SITE / 'index.html'}: every link leads somewhere\n")


def prepare(root: Path, source: Path, config: Path) -> None:
    """Write the pages and pictures of a clone to a new folder, and the site's settings to a file."""
    for pattern in PAGES:
        for page in root.glob(pattern):
            _write(source / page.relative_to(root), _for_site(page, root, source))
    shutil.copytree(root / "docs" / "pictures", source / "docs" / "pictures")
    for drawing in (source / "docs" / "pictures").glob("*.svg"):
        _two_drawings(drawing)
    settings = (root / "zensical.toml").read_text(encoding="utf-8")
    settings = settings.replace("[project]\n", f"[project]\nnav = {_nav(root)}\n{_about(root)}", 1)
    config.write_text(settings, encoding="utf-8")


def unfound(index: list[dict[str, Any]], searches: Iterable[str]) -> list[str]:
    """Return the searches that find no section with all their words in its title, its text or the titles above."""
    texts = [" ".join([item["title"], item["text"], *item["path"]]).lower() for item in index]
    return [
        words for words in searches if not any(all(word in text for word in words.lower().split()) for text in texts)
    ]


def _zensical() -> None:
    environment = {**os.environ, "UV_PROJECT_ENVIRONMENT": str(ENVIRONMENT), "UV_PYTHON_DOWNLOADS": "never"}
    environment.pop("VIRTUAL_ENV", None)
    sync = [bootstrap.find_uv(), "sync", "--frozen", "--only-group", "docs", "--quiet", "--python", sys.executable]
    subprocess.run(sync, cwd=ROOT, env=environment, check=True)
    program = ENVIRONMENT / ("Scripts/zensical.exe" if os.name == "nt" else "bin/zensical")
    if subprocess.run([program, "build", "--clean", "--strict"], cwd=BUILD, check=False).returncode != 0:
        sys.exit("the site could not be built: see above")


def _write(target: Path, text: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text, encoding="utf-8")


def _for_site(page: Path, root: Path, source: Path) -> str:
    """Return a page with the links that leave the documentation led to pages of code."""

    def link(found: re.Match[str]) -> str:
        target = (page.parent / unquote(found[1])).resolve()
        if target.suffix in (".md", ".svg", ".png") or not target.exists():
            return found[0]
        if (target / "README.md").is_file():
            return f"]({found[1].rstrip('/')}/README.md)"
        return f"]({posixpath.relpath(_code_page(target, root, source), page.parent.relative_to(root).as_posix())})"

    text = LINK.sub(link, page.read_text(encoding="utf-8"))
    # the page has a switch of its own: a drawing that follows the screen would be dark on a light page
    text = DRAWING.sub(r"![\1](\2.svg#only-light)\n![\1](\2-dark.svg#only-dark)", text)
    # Python-Markdown wants an empty line before a list, and four spaces within one
    text = re.sub(r"^(?![-*|>#\s]|\d+\. |```)(.+)\n(?=(?:- |\* |1\. ))", r"\1\n\n", text, flags=re.MULTILINE)
    return re.sub(r"^( {2,3})(?=- )", "    ", text, flags=re.MULTILINE)


def _two_drawings(drawing: Path) -> None:
    """Replace a drawing that follows the screen by a light one and a dark one."""
    text = drawing.read_text(encoding="utf-8")
    drawing.write_text(drawing_colours.light(text), encoding="utf-8")
    drawing.with_name(f"{drawing.stem}-dark.svg").write_text(drawing_colours.dark(text), encoding="utf-8")


def _about(root: Path) -> str:
    """Return the version and the repository for the head and foot of every page, as TOML.

    The repository is `Repository` of `[project.urls]`; without it, the place that this clone came from.
    """
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = f"afspm {project['version']}"
    lines = [f"site_name = {json.dumps(version)}", f"copyright = {json.dumps(version)}"]
    repository = project.get("urls", {}).get("Repository") or _origin(root)
    if repository:
        lines += [f"repo_url = {json.dumps(repository)}", 'repo_name = "repository"']
    else:
        sys.stderr.write("no link to the repository: [project.urls] has no Repository, and git no https origin\n")
    return "\n".join(lines) + "\n"


def _origin(root: Path) -> str:
    ask = ["git", "config", "--get", "remote.origin.url"]
    url = subprocess.run(ask, cwd=root, capture_output=True, encoding="utf-8", check=False).stdout.strip()
    return url if url.startswith("https://") else ""


def _code_page(target: Path, root: Path, source: Path) -> str:
    """Write a file, or the files of a folder, as a page; return its path."""
    name = target.relative_to(root).as_posix()
    files = sorted(target.iterdir()) if target.is_dir() else [target]
    parts = [
        f"## {file.name}\n\n````{FENCES.get(file.suffix, 'text')}\n{file.read_text(encoding='utf-8')}\n````\n"
        for file in files
        if file.is_file() and file.suffix in (*FENCES, ".cff", "")
    ]
    page = f"{name}/index.md" if target.is_dir() else f"{name}.md"
    _write(source / page, f"# {name}\n\n" + "\n".join(parts))
    return page


def _nav(root: Path) -> str:
    """Return the navigation as TOML: the sections of docs/README.md."""
    listing = (root / "docs/README.md").read_text(encoding="utf-8")
    entries: list[str] = ['"README.md"']
    for title, text in SECTION.findall(listing):
        pages = [posixpath.normpath(f"docs/{target}") for target, _ in LINK.findall(text)]
        shown = [_group(root, page) if page.endswith("/README.md") else json.dumps(page) for page in pages]
        entries.append(f"{{ {json.dumps(title)} = [{', '.join(shown)}] }}")
    return "[\n  " + ",\n  ".join(entries) + ",\n]"


def _group(root: Path, listing: str) -> str:
    """Return a page that lists others, with these below it."""
    folder = (root / listing).parent
    pages = [page.relative_to(root).as_posix() for page in sorted(folder.rglob("*.md")) if page != root / listing]
    title = (root / listing).read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    return f"{{ {json.dumps(title)} = {json.dumps([listing, *pages])} }}"


class _Page(HTMLParser):
    """The links and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors = {"", "__search"}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value:
                self.links.append(value)


def _broken_links() -> Iterator[str]:
    pages = {file: _Page(file.read_text(encoding="utf-8")) for file in SITE.rglob("*.html")}
    for file, page in pages.items():
        for link in page.links:
            url = urlsplit(link)
            if url.scheme or url.netloc:
                continue
            base = SITE if url.path.startswith("/") else file.parent
            target = (base / unquote(url.path).lstrip("/")).resolve() if url.path else file
            target = target / "index.html" if target.is_dir() else target
            known = pages[target].anchors if target in pages else {url.fragment}
            if file.name != "404.html" and (not target.exists() or unquote(url.fragment) not in known):
                yield f"{file.relative_to(SITE)} links to {link}, which is not there"


if __name__ == "__main__":
    main()
