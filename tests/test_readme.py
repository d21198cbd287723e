"""The README's Python snippets run, and say what they claim."""

import re
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
SNIPPETS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_snippet_runs(number, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(compile(SNIPPETS[number], f"README.md, snippet {number}", "exec"), names)
    if "coder" in names:
        found = names["memory"](names["coder"](names["joints"][10]), names["touch"])
        torch.testing.assert_close(found, names["joints"][11], atol=0.01, rtol=0)
        assert "follows" in capsys.readouterr().out
    if "target" in names:
        start = torch.from_numpy(names["data"].episodes[0].state[0])
        torch.testing.assert_close(names["target"], start, atol=1e-6, rtol=0)


def test_there_are_snippets():
    assert len(SNIPPETS) >= 2
