"""What the README and the documentation say is so: code runs, commands and links exist."""

from __future__ import annotations

import html
import inspect
import re
import shlex
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import pytest

import pixelbrax_gym  # a page that registers its ids first would take them away
from pixelbrax_jax import registry
from pixelbrax_jax.tasks import BRAX_TASKS

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]

FENCE = re.compile(r"^(?P<indent>\s*)```(?P<language>\w*)")
NOT_RUN = re.compile(r"^\s*<!-- not run: \S.*-->\s*$")
LINK = re.compile(r"\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)|<img[^>]*\ssrc=\"([^\"]+)\"")
SNIPPET = re.compile(r"^\s*--8<-- \"([^:\"]+)(?::([\w-]+))?\"", re.MULTILINE)


ADAPTERS = (
    pixelbrax_gym.GymnasiumEnv,
    pixelbrax_gym.GymnasiumVectorEnv,
    pixelbrax_gym.TorchRLEnv,
    pixelbrax_gym.SB3VecEnv,
)
"""In the order of the columns in docs/options.md."""


LONG = {
    *("docs/agents/index.md", "docs/dataflow.md", "docs/renderer.md"),
    *("docs/reproducibility.md", "docs/results.md", "docs/howto/brax-trainers.md"),
    *("docs/howto/goals.md", "docs/howto/observations.md", "docs/howto/own-algorithm.md"),
    *("docs/howto/own-task.md", "docs/howto/recipes.md"),
}
"""Pages whose code takes longer than that of where a reader begins."""


@dataclass(frozen=True)
class Block:
    """A fenced block of code; ``line`` is where its code begins."""

    language: str
    line: int
    code: str
    runs: bool


def blocks_of(text: str) -> Iterator[Block]:
    """The fenced blocks of a page, in order."""
    lines, above, i = text.splitlines(), "", 0
    while i < len(lines):
        fence = FENCE.match(lines[i])
        if fence is None:
            above = lines[i] if lines[i].strip() else above
            i += 1
            continue
        start = i = i + 1
        while lines[i].strip() != "```":
            i += 1
        code = textwrap.dedent("\n".join(lines[start:i])) + "\n"
        yield Block(fence["language"], start + 1, code, not NOT_RUN.match(above))
        above, i = "", i + 1


def without_code(text: str) -> str:
    """A page without fenced blocks and code spans."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^\s*```.*?^\s*```$", "", text, flags=re.S | re.M))


def anchors_of(text: str) -> set[str]:
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", without_code(text.replace("`", "")), flags=re.M)
    plain = [re.sub(r"[^\w\- ]", "", html.unescape(heading)).strip() for heading in headings]
    return {re.sub(r"\s+", "-", heading.lower()) for heading in plain}


def whole(inclusion: re.Match[str]) -> str:
    """The file that a page includes; of a section, all of its file."""
    return (ROOT / inclusion[1]).read_text("utf-8")


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.M))


@pytest.fixture
def _own_registries():
    """A page may register tasks; the next test does not see them."""
    tables = (gymnasium.registry, registry._OWN_TASKS)
    before = [dict(table) for table in tables]
    yield
    for table, kept in zip(tables, before, strict=True):
        table.clear()
        table.update(kept)


@pytest.mark.usefixtures("_own_registries")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in NAMES]
)
def test_python_blocks_run(name, tmp_path, monkeypatch):
    blocks = [b for b in blocks_of((ROOT / name).read_text("utf-8")) if b.language == "python"]
    if not blocks:
        return
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    for block in blocks:
        # The empty lines make a traceback point at the line of the page.
        code = compile("\n" * (block.line - 1) + block.code, str(ROOT / name), "exec")
        if block.runs:
            exec(code, namespace)


@pytest.mark.parametrize("name", NAMES)
def test_make_commands_exist(name):
    for block in blocks_of((ROOT / name).read_text("utf-8")):
        if block.language not in ("bash", "console", "sh"):
            continue
        for line in block.code.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["make"]:
                targets = {w for w in words[1:] if "=" not in w and not w.startswith("-")}
                assert targets <= make_targets(), f"{name}: {line}"


@pytest.mark.parametrize("name", NAMES)
def test_links_resolve(name):
    page = ROOT / name
    for first, second in LINK.findall(without_code(page.read_text("utf-8"))):
        link = first or second
        if re.match(r"https?://|mailto:", link):
            continue
        target, _, anchor = link.partition("#")
        file = (page.parent / target).resolve() if target else page
        assert file.exists(), f"{name}: {link}"
        assert file.is_relative_to(ROOT), f"{name}: {link}"
        if anchor and file.suffix == ".md":
            text = SNIPPET.sub(whole, file.read_text("utf-8"))
            assert anchor in anchors_of(text), f"{name}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_no_line_of_a_paragraph_begins_with_a_figure(page):
    """Markdown would end the paragraph before a line that begins with a comment."""
    found = re.findall(r"^ *<!-- [\w-]+ -->\S.*", page.read_text("utf-8"), re.MULTILINE)
    assert not found


@pytest.mark.parametrize("name", NAMES)
def test_included_sections_exist(name):
    page = (ROOT / name).read_text("utf-8")
    for file, section in SNIPPET.findall(page):
        text = (ROOT / file).read_text("utf-8")
        if section:
            for end in ("start", "end"):
                assert text.count(f"--8<-- [{end}:{section}]") == 1, f"{name}: {file}:{section}"
    # A formatter may take the scissors of an inclusion for Python and spread them out.
    assert len(re.findall(r"^\s*-+ ?8 ?<", page, re.MULTILINE)) == len(SNIPPET.findall(page))


def test_every_brax_task_has_its_animation():
    page = (ROOT / "docs/tasks.md").read_text("utf-8")
    shown = re.findall(r"!\[(\w+)\]\((images/tasks/\w+\.webp)\)", page)
    assert shown == [(name, f"images/tasks/{name}.webp") for name in BRAX_TASKS]


def test_the_options_of_adapters_are_listed():
    page = (ROOT / "docs/options.md").read_text("utf-8")
    heading = "| option | Gymnasium `make` |"
    listed: list[set[str]] = [set() for _ in ADAPTERS]
    for line in page[page.index(heading) :].split("\n\n")[0].splitlines()[2:]:
        names, *cells, _ = line.strip("|").split("|")
        for options, cell in zip(listed, cells, strict=True):
            options |= set(re.findall(r"`([^`]*)`", names)) if cell.strip() == "yes" else set()
    for adapter, options in zip(ADAPTERS, listed, strict=True):
        taken = set(inspect.signature(adapter.__init__).parameters)
        assert options == taken - {"self", "task", "options"}, adapter


def test_blocks_are_found():
    page = (
        "a\n```python\nx = 1\n```\n<!-- not run: why -->\n\n    ```bash\n    make demo\n    ```\n"
    )
    assert list(blocks_of(page)) == [
        Block("python", 3, "x = 1\n", runs=True),
        Block("bash", 8, "make demo\n", runs=False),
    ]
