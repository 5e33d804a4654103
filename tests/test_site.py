"""The documentation: generated pages are up to date, links resolve, and the site builds."""

import importlib
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import hdjax
from hdjax.parameters import own_parameters

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PACKAGES = ("fitting", "hdjax", "hdjax.design", "hdjax.effects", "hdjax.response", "hdjax.sweep")
CONFIG = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built in strict mode: a warning ends the build."""
    pytest.importorskip("zensical", reason="needs the extra `docs`")
    room = tmp_path_factory.mktemp("site")
    for name in ("CHANGELOG.md", "zensical.toml"):
        shutil.copy(ROOT / name, room)
    for name in ("docs", "fitting", "hdjax"):
        shutil.copytree(ROOT / name, room / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    built = subprocess.run(command, cwd=room, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stdout + built.stderr
    return room / CONFIG["site_dir"]


def pages_of(nav: list) -> Iterator[str]:
    for entry in nav:
        for value in entry.values():
            yield from pages_of(value) if isinstance(value, list) else [value]


def heading_anchors(page: str) -> set[str]:
    """Anchors of headings as repository hosts make them: lower case, hyphens for blanks, no punctuation."""
    headings = re.findall(r"^#+ (.*)$", page, flags=re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.replace("`", "")) for heading in headings)
    return {heading.strip().lower().replace(" ", "-") for heading in plain} | set(re.findall(r'<a id="([^"]+)"', page))


def broken_links(path: Path) -> list[str]:
    """Links of a Markdown page whose file or heading does not exist in the repository."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    missing = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        parts = urlsplit(link)
        if parts.scheme:
            continue
        target = path.parent / unquote(parts.path) if parts.path else path
        found = target.exists()
        if found and parts.fragment and target.suffix == ".md":
            found = parts.fragment in heading_anchors(target.read_text(encoding="utf-8"))
        if not found:
            missing.append(link)
    return missing


def test_generated_pages_are_up_to_date(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    for path, text in importlib.import_module("generate").generated().items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name} is out of date: run `make docs`"


def test_glossary_has_every_parameter_of_a_drive_with_its_unit():
    rows = re.findall(r"^\| .* \|$", (DOCS / "glossary.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    told = {(symbol, unit) for *_, symbols, unit in cells for symbol in re.findall(r"`([^`]+)`", symbols)}
    drive = hdjax.hdc_40_050()
    # One row stands for alpha of both kinds of log; a reduced log has units of its own.
    known = {(name, info.unit) for name, info in (*own_parameters(drive), *own_parameters(drive.reduced()))}
    assert known - {("alpha", "1/[x]^2")} <= told


def test_navigation_lists_every_page():
    listed = list(pages_of(CONFIG["nav"]))
    assert sorted(listed) == sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))


def test_links_between_pages_resolve():
    for path in (*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "benchmarks").rglob("*.md")):
        assert broken_links(path) == [], path


def test_broken_links_are_detected(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One\n\n[a](page.md#one) [b](page.md#two) [c](other.md) [d](#one)\n", encoding="utf-8")
    assert broken_links(page) == ["page.md#two", "other.md"]


def test_site_builds_and_its_links_resolve(site):
    pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    names = {path: set(re.findall(r'\bid="?([^"\s>]+)', text)) for path, text in pages.items()}
    assert len(pages) > 20
    for path, text in pages.items():
        for link in re.findall(r'<a\s[^>]*?href="?([^"\s>]+)', text):
            parts = urlsplit(link)
            # The page 404.html has links from the root of a server.
            if parts.scheme or path.name == "404.html":
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            assert target.exists(), (path.name, link)
            assert not parts.fragment or target not in names or unquote(parts.fragment) in names[target], (
                path.name,
                link,
            )


def test_site_loads_nothing_from_a_network(site):
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)\s[^>]*?src="?([^"\s>]+)', text)
        loaded += re.findall(r'<link\s[^>]*?href="?([^"\s>]+)', text)
        assert not [link for link in loaded if urlsplit(link).netloc], path.name


@pytest.mark.parametrize("package", PACKAGES)
def test_reference_describes_every_public_name(site, package):
    page = (site / "reference" / f"{package.replace('.', '_')}.html").read_text(encoding="utf-8")
    described = set(re.findall(rf'id="({re.escape(package)}\.[^"]+)"', page))
    for name in importlib.import_module(package).__all__:
        assert any(place.endswith(f".{name}") for place in described), name
