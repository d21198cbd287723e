"""The pages are true: the site builds, every block runs, every command and message is real."""

import importlib.util
import io
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stderr
from dataclasses import is_dataclass
from importlib.metadata import metadata
from pathlib import Path

import draccus
import pytest
import torch

import hasm_torch
import hasm_torch.data
import hasm_torch.robot
import hasm_torch.sim

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {page.name: page.read_text() for page in PAGES}
# Python that runs, and where a text follows at once, the message that it must end in.
BLOCK = re.compile(r"```python\n(.*?)```\n(?:\n```text\n(.*?)\n```)?", re.S)
APART = ("README.md", "index.md", "recordings.md", "robot.md")  # robot.md: tests/test_add_skin.py
RUNNING = [name for name, text in TEXTS.items() if BLOCK.search(text) and name not in APART]
PROGRAMS = {
    "train.py": "hasm_torch.apps.training",
    "eval.py": "hasm_torch.apps.evaluation",
    "touch.py": "hasm_torch.apps.touch",
    "hasm-train": "hasm_torch.apps.training",
    "hasm-eval": "hasm_torch.apps.evaluation",
    "hasm-touch": "hasm_torch.apps.touch",
    "hasm-record": "hasm_torch.apps.record",
    "hasm-import": "hasm_torch.apps.import_bags",
    "hasm-skin": "hasm_torch.apps.skin",
    "lerobot-train": "lerobot.configs.train.TrainPipelineConfig",
    "lerobot-rollout": "lerobot.rollout.configs.RolloutConfig",
    "lerobot-eval": "lerobot.configs.eval.EvalPipelineConfig",
}
NO_PROGRAM = ("export", "pip", "git")
# Options that name files which are not there, or stand elsewhere on the page, and what LeRobot's
# programs would find in their place.
READ_APART = {
    "--config_path=": ["--dataset.repo_id=any"],
    "--policy.path=": ["--policy.type=hasm"],
    "...": ["--policy.type=hasm", "--robot.type=hsr"],
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder that looks like a checkout, to write in."""
    for name in ("datasets", "assets", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", sys.argv[:])
    return tmp_path


def message(error: BaseException, said: str) -> str:
    """What a person reads: of a program that ends with a number, its last line."""
    if isinstance(error, SystemExit) and isinstance(error.code, int):
        return said.strip().splitlines()[-1]
    return str(error)


def matches(expected: str, came: str) -> bool:
    """Whether a message is the expected one, … standing for anything."""
    return re.fullmatch(".*".join(map(re.escape, expected.split("…"))), came, re.S) is not None


def run_blocks(name: str) -> dict:
    """Run a page's blocks one after the other, in one namespace."""
    names: dict = {"__name__": name}
    for number, (block, expected) in enumerate(BLOCK.findall(TEXTS[name])):
        code = compile(block, f"{name}, block {number}", "exec")
        if not expected:
            exec(code, names)
            continue
        with (
            pytest.raises((Exception, SystemExit)) as raised,
            redirect_stderr(io.StringIO()) as err,
        ):
            exec(code, names)
        came = message(raised.value, err.getvalue())
        assert matches(expected, came), f"{name} promises\n{expected}\nbut it is\n{came}\n{block}"
    return names


@pytest.mark.parametrize("name", RUNNING)
def test_blocks_run(name, folder):
    run_blocks(name)


def test_the_readme_recalls_what_followed(folder, capsys):
    names = run_blocks("README.md")
    found = names["memory"](names["coder"](names["joints"][10]), names["touch"])
    torch.testing.assert_close(found, names["joints"][11], atol=0.01, rtol=0)
    assert "follows" in capsys.readouterr().out


def test_the_start_learns_forgets_and_explains(folder, capsys):
    names = run_blocks("index.md")
    start = torch.from_numpy(names["data"].episodes[0].state[0])
    torch.testing.assert_close(names["target"], start, atol=1e-6, rtol=0)
    assert names["known"].number == 12  # of twelve episodes one was forgotten and came back
    assert names["why"].patch == "wrist_right"
    assert 12 in names["why"].episodes
    assert "posture known: True  touch known: True" in capsys.readouterr().out


def test_another_message_is_not_taken_for_the_promised_one():
    assert matches("no file … here", "no file a/b here")
    assert not matches("no file … here", "no file a/b there")
    assert not matches("expected (8,)", "expected (9,)")


def test_troubleshooting_promises_a_message_in_every_entry():
    entries = re.split(r"^### ", TEXTS["troubleshooting.md"], flags=re.M)[1:]
    assert len(entries) > 100
    for entry in entries:
        ((_, promised),) = BLOCK.findall(entry)
        mend = entry.rsplit("```", 1)[1].split("\n## ")[0].strip()
        assert promised, entry
        assert mend, entry


# ------------------------------------------------------------------------------- commands


def commands(text: str) -> list[list[str]]:
    """Commands of bash blocks, and those that stand in a line of text."""
    blocks = re.findall(r"```bash\n(.*?)```", text, re.S)
    lines = [line for b in blocks for line in b.replace("\\\n", " ").splitlines()]
    indented = re.sub(r" *\\\n *", " ", re.sub(r" +#.*", "", text))
    lines += re.findall(r"^    (uv run .*)", indented, re.M)
    lines += re.findall(r"`((?:uv run|python -m) [^`]+)`", text.replace("```", ""))
    found = [shlex.split(line, comments=True) for line in lines]
    return [words for words in found if words]


COMMANDS = [(page, words) for page, text in TEXTS.items() for words in commands(text)]


def program_of(words: list[str]) -> tuple[str, list[str]]:
    """Program and options, without the uv or python in front."""
    if words[:2] == ["uv", "run"]:
        words = words[2:]
        while words[0].startswith("--"):
            words = words[1:]
    if words[:2] == ["python", "-m"]:
        words = words[2:]
    return words[0], words[1:]


def options_class(program: str) -> type | None:
    """The dataclass of a program's options, or None where it has another parser."""
    if program.startswith("lerobot-"):
        importlib.import_module("hasm_torch.lerobot.modeling_hasm")
        importlib.import_module("hasm_torch.lerobot.env_hsr_touch")
        importlib.import_module("hasm_torch.lerobot.hsr")
        module, name = PROGRAMS[program].rsplit(".", 1)
        return getattr(importlib.import_module(module), name)
    name = PROGRAMS.get(program, program)
    if name.endswith(".py") and (ROOT / name).is_file():
        name = name.removesuffix(".py").replace("/", ".")
    if not name.startswith(("hasm_torch.", "benchmarks.", "examples.")):
        return None
    module = importlib.import_module(name)
    mine = [x for x in vars(module).values() if is_dataclass(x) and isinstance(x, type)]
    named = [x for x in mine if re.fullmatch(r"Options|\w+Config", x.__name__)]
    (found,) = [x for x in named if f"parse_options({x.__name__})" in source(module)] or [
        x for x in named if f"config_class={x.__name__}" in source(module)
    ]
    return found


def source(module) -> str:
    return Path(module.__file__).read_text()


@pytest.mark.parametrize(
    ("page", "words"), COMMANDS, ids=lambda x: x if isinstance(x, str) else x[-1]
)
def test_commands_and_their_options_exist(page, words, monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    program, options = program_of(words)
    if words[:2] == ["pip", "install"]:
        extras = re.findall(r"(?:hasm-torch|\.)\[(.*)\]", words[2])
        known = metadata("hasm-torch").get_all("Provides-Extra") or []
        assert words[2].partition("[")[0] in ("uv", "hasm-torch", ".")
        assert set(",".join(extras).split(",")) - {""} <= set(known)
        return
    if program in NO_PROGRAM:
        return
    found = options_class(program)
    if found is not None:
        for flag, read in READ_APART.items():
            if any(option.startswith(flag) for option in options):
                options = [x for x in options if not x.startswith(flag)]
                options += read if program.startswith("lerobot-") else []
        draccus.parse(found, args=options)  # ends the program at an option that does not exist
        return
    if "-m" in words:
        assert importlib.util.find_spec(program), f"{page}: there is no module {program}"
        return
    path = shutil.which(program, path=f"{Path(sys.executable).parent}:/usr/bin:/usr/local/bin")
    path = path or shutil.which(program)
    assert path, f"{page}: there is no program {program}"
    flags = [option for option in options if option.startswith("-")]
    if flags:
        verbs = [option for option in options if re.fullmatch(r"[a-z]+", option)][:1]
        help_command = [path, *verbs, "--help"]
        told = subprocess.run(
            help_command, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        for flag in flags:
            assert flag.split("=")[0] in told.stdout, f"{page}: {program} has no {flag}"


def test_an_option_that_does_not_exist_is_noticed():
    with pytest.raises(SystemExit):
        draccus.parse(options_class("train.py"), args=["--dataset.rot=x"])


def main_of(words: list[str], monkeypatch) -> None:
    """Run a command in this process."""
    program, options = program_of(words)
    monkeypatch.setattr("sys.argv", [program, *options])
    importlib.import_module(PROGRAMS.get(program, program)).main()


def command(page: str, start: str) -> list[str]:
    """The one command of a page that starts so."""
    (found,) = [w for p, w in COMMANDS if p == page and shlex.join(w).startswith(start)]
    return found


def test_the_start_trains(folder, monkeypatch, capsys):
    main_of(command("index.md", "uv run train.py"), monkeypatch)
    assert (folder / "outputs/train/yield/model.safetensors").is_file()
    assert "checkpoint: outputs/train/yield" in capsys.readouterr().out


def test_recorded_arrays_become_a_dataset(folder, monkeypatch):
    run_blocks("recordings.md")
    main_of(command("recordings.md", "uv run hasm-record --root=data/arrays"), monkeypatch)
    assert len(hasm_torch.data.load_episodes("data/arrays")) == 2


# ----------------------------------------------------------------------------------- site


def test_every_public_name_is_on_the_page_of_the_api():
    listed = set(re.findall(r"^::: (\S+)", TEXTS["api.md"], re.M))
    for module in (hasm_torch, hasm_torch.robot, hasm_torch.sim, hasm_torch.data):
        for name in set(module.__all__) - {"__version__"}:
            assert f"{module.__name__}.{name}" in listed, name


def test_links_between_files_of_the_repository_lead_somewhere():
    for page in PAGES:
        text = re.sub(r"```.*?```", "", TEXTS[page.name], flags=re.S)
        for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
            assert link.startswith("http") or (page.parent / link).exists(), f"{page.name}: {link}"


def test_the_readme_is_one_screen():
    assert len(TEXTS["README.md"].splitlines()) <= 150


def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path):
    for name in ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers.python"):
        pytest.importorskip(name, reason="the site is built by the group dev")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    pages = {page.name: page.read_text() for page in tmp_path.glob("*.html")}
    assert {Path(name).stem for name in TEXTS if (ROOT / "docs" / name).exists()} <= {
        Path(name).stem for name in pages
    }
    for name, html in pages.items():
        for tag in re.findall(r"<(?:script|link|img|video)\b[^>]*>", html):
            for where in re.findall(r'(?:src|href)="([^"]+)"', tag):
                assert not where.startswith(("http", "//")), f"{name} loads {where}"
                if name != "404.html":
                    assert (tmp_path / where.split("#")[0].split("?")[0]).exists(), where
    assert "inverse temperature" in pages["api.html"].lower()  # docstrings came along
