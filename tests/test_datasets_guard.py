"""The folder of recordings must never shadow the package `datasets` that LeRobot imports."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FORBIDDEN = ("__init__.py", "test_*.py", "*_test.py", "conftest.py")


def python_in(folder: Path) -> list[Path]:
    """Files that make pytest or Python take a folder for a package."""
    return sorted(path for pattern in FORBIDDEN for path in folder.rglob(pattern))


def test_recordings_are_no_package():
    assert python_in(ROOT / "datasets") == []


@pytest.mark.parametrize("name", ["__init__.py", "deep/test_x.py"])
def test_guard_finds_an_offender(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    assert python_in(tmp_path) == [tmp_path / name]


def test_wheel_does_not_ship_the_recordings():
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    wheel = build["targets"]["wheel"]
    shipped = [*wheel["packages"], *wheel.get("force-include", {})]
    assert not [path for path in shipped if Path(path).parts[0] == "datasets"]
