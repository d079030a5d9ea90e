"""Who may import whom, what the command line may load, how files are named and how long they are."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sensors", "egovm", "fusion", "replay")
MAY_IMPORT = {
    "sensors": set(),
    "egovm": {"sensors"},
    "fusion": {"sensors"},
    "replay": {"sensors", "egovm", "fusion"},
}
FORBIDDEN_NAMES = {"utils", "util", "helpers", "types", "time"}
MAX_LINES = 350


def modules(package: str) -> list[Path]:
    """Python files of a package."""
    return sorted((ROOT / package).rglob("*.py"))


def imported_packages(source: str) -> Iterator[str]:
    """Top-level names that a source imports, at any depth of its code."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (name.name.partition(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "" if node.level else (node.module or "").partition(".")[0]


def test_the_walk_sees_imports_inside_functions() -> None:
    source = "def f():\n    import fusion.run\n    from egovm import x\nfrom . import y\n"
    assert sorted(imported_packages(source)) == ["", "egovm", "fusion"]


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_what_lies_below_them(package: str) -> None:
    above = set(PACKAGES) - MAY_IMPORT[package] - {package}
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules(package)
        for name in imported_packages(path.read_text())
        if name in above
    ]
    assert modules(package)
    assert wrong == []


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_are_absolute(package: str) -> None:
    relative = [p for p in modules(package) if "" in imported_packages(p.read_text())]
    assert relative == []


def test_the_command_line_loads_nothing_heavy() -> None:
    code = "import sys, replay.cli; print(*sorted({m.partition('.')[0] for m in sys.modules}))"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = set(printed.stdout.split())
    assert "replay" in loaded
    assert loaded.isdisjoint({"torch", "rerun", "matplotlib", "filterpy"})


def test_no_module_is_named_after_nothing() -> None:
    named = [p for package in PACKAGES for p in modules(package) if p.stem in FORBIDDEN_NAMES]
    assert named == []


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()


def test_every_folder_of_modules_is_a_package() -> None:
    folders = {p.parent for package in PACKAGES for p in modules(package)}
    assert [f for f in folders if not (f / "__init__.py").is_file()] == []


def test_files_stay_short() -> None:
    lengths = {p: p.read_text().count("\n") for package in PACKAGES for p in modules(package)}
    assert {str(p.relative_to(ROOT)): n for p, n in lengths.items() if n > MAX_LINES} == {}
