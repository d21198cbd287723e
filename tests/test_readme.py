"""The README's Python snippets run, and say what they claim."""

import re
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
SNIPPETS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)


def test_snippets_run_one_after_the_other(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    names: dict = {}
    for number, snippet in enumerate(SNIPPETS):
        exec(compile(snippet, f"README.md, snippet {number}", "exec"), names)
    said = capsys.readouterr().out
    found = names["memory"](names["coder"](names["joints"][10]), names["touch"])
    torch.testing.assert_close(found, names["joints"][11], atol=0.01, rtol=0)
    assert "follows" in said
    start = torch.from_numpy(names["data"].episodes[0].state[0])
    torch.testing.assert_close(names["target"], start, atol=1e-6, rtol=0)
    assert names["known"].number == 12  # of twelve episodes one was forgotten and came back
    assert names["why"].patch == "wrist_right"
    assert 12 in names["why"].episodes
    assert "posture known: True  touch known: True" in said


def test_there_are_snippets():
    assert len(SNIPPETS) >= 3
