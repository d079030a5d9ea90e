"""What README.md tells a newcomer to type works, and what it links to is there."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EGOLOC = ".venv/bin/egoloc "


def commands() -> list[str]:
    """Lines of README.md that call egoloc."""
    return [line for line in PAGES[0].read_text().splitlines() if line.startswith(EGOLOC)]


def run(line: str, folder: Path) -> str:
    """Run one of them in a folder, without opening a window; returns what it prints."""
    words = shlex.split(line.removeprefix(EGOLOC))
    words += ["--no-open"] if words[0] == "view" else []
    code = "import sys; from replay.cli import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{line}\n{done.stderr}"
    return done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    targets = [target for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()) if "://" not in target]
    assert [target for target in targets if not (page.parent / target).exists()] == []


def anchors(page: Path) -> set[str]:
    """What links may name of a page: its headings, as GitHub writes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_into_pages_name_a_heading(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s:]*)#([^)\s]+)\)", page.read_text())
    assert [(name, part) for name, part in targets if part not in anchors(page.parent / name if name else page)] == []


def test_every_page_is_linked_from_the_readme() -> None:
    linked = set(re.findall(r"\]\((docs/[\w-]+\.md)\)", PAGES[0].read_text()))
    assert linked == {f"docs/{page.name}" for page in PAGES[1:]}


def test_make_targets_exist() -> None:
    told = set(re.findall(r"(?:^|`)make ([a-z-]+)", "\n".join(page.read_text() for page in PAGES), re.MULTILINE))
    makefile = (ROOT / "Makefile").read_text()
    assert {"demo", "test"} <= told
    assert {target for target in told if not re.search(rf"^{target}:", makefile, re.MULTILINE)} == set()


@pytest.mark.slow
def test_a_real_log_is_replayed_by_the_lines_shown(tmp_path: Path, data: Path) -> None:
    (tmp_path / "rtk_drive").symlink_to(data / "rtk_drive")
    lines = [line for line in commands() if "rtk" in line]
    printed = [run(line, tmp_path) for line in lines]
    assert [line.split()[1] for line in lines] == ["convert", "replay", "view"]
    assert "median" in printed[1]
    assert (tmp_path / "runs/rtk/run.rrd").is_file()


@pytest.mark.slow
def test_two_runs_are_compared_by_the_lines_shown(tmp_path: Path) -> None:
    run(f"{EGOLOC}demo", tmp_path)
    (tmp_path / "tuned.toml").write_text("[fusion.gnss]\ninflation = 8.0\n")
    lines = [line for line in commands() if "tuned" in line]
    assert [line.split()[1] for line in lines] == ["replay", "view"]
    for line in lines:
        run(line, tmp_path)
    assert (tmp_path / "runs/demo_and_tuned.rrd").is_file()
