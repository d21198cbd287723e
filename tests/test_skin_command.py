"""``hasm-skin`` on the HSR's own URDF: what it writes is a skin that the rest reads."""

import pytest
import torch

from hasm_torch._assets import asset_path
from hasm_torch.apps.skin import main
from hasm_torch.data.skin import skin_from_info, skin_patches, skin_to_info
from hasm_torch.robot import Skin

MODEL = f"--model={asset_path('hsr.urdf')}"


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Runs the command in an empty folder; what it prints."""

    def run(*options):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", ["hasm-skin", *options])
        main()
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize("surface", ["box", "mesh"])
def test_one_patch_by_options(command, tmp_path, surface):
    options = ["--link=wrist_roll_link", f"--surface={surface}", "--toward=[-1, 0, 0]"]
    said = command(MODEL, *options, "--name=upper", "--out=made/skin.json")
    made, known = Skin.load(tmp_path / "made" / "skin.json"), Skin.load()
    assert made.patches == ("upper",)
    assert made.link == {"upper": "wrist_roll_link"}
    # The cells lie in the plane in which the HSR's own do, and look the same way.
    own = known.slices["wrist_upper"]
    torch.testing.assert_close(
        made.positions[:, 0], known.positions[own][:1, 0].expand(made.cells), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(
        made.normals, known.normals[own][:1].expand(made.cells, 3), rtol=0, atol=1e-6
    )
    assert ("upper" in made.surfaces) == (surface == "box")
    header, row, last = said.splitlines()
    assert header.split()[:3] == ["patch", "link", "cells"]
    assert row.split()[:3] == ["upper", "wrist_roll_link", str(made.cells)]
    assert last == f"made/skin.json: {made.cells} cells"


def test_several_patches_by_a_file_go_into_a_dataset(command, tmp_path):
    (tmp_path / "skin.yaml").write_text(
        f"model: {asset_path('hsr.urdf')}\n"
        "out: both.json\n"
        "patches:\n"
        "- {name: upper, link: wrist_roll_link, surface: box, toward: [-1, 0, 0]}\n"
        "- {name: arm, link: arm_roll_link, upper: [1.0, 1.0, 0.2], pitch: 0.02}\n"
    )
    said = command("--config_path=skin.yaml")
    made = Skin.load(tmp_path / "both.json")
    assert made.patches == ("upper", "arm")
    assert [line.split()[0] for line in said.splitlines()[1:3]] == ["upper", "arm"]
    info = skin_to_info(skin_patches(made), made.cells, 3)
    again = skin_from_info({"info": info}, made.cells, 3, "observation.tactile")
    for name in made.patches:
        assert again[name].cells == made.slices[name]
        torch.testing.assert_close(
            torch.from_numpy(again[name].normals), made.normals[made.slices[name]]
        )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--link=wrist_roll_link"], "expected --model"),
        (["--model=none.xml"], "no file none.xml"),
        ([MODEL, "--link=wrist"], "no link 'wrist'; the links are: .*wrist_roll_link"),
        ([MODEL, "--link=wrist_roll_link", "--surface=ball"], "one of box, capsule, cylinder"),
        ([MODEL, "--link=wrist_roll_link", "--surface=capsule"], "needs one capsule.*found 0"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(command, tmp_path, options, says):
    with pytest.raises(SystemExit, match=says) as stopped:
        command(*options)
    assert "\n" not in str(stopped.value)
    assert not list(tmp_path.iterdir())


def test_help_explains_every_option(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["hasm-skin", "--help"])
    with pytest.raises(SystemExit, match="0"):
        main()
    said = " ".join(capsys.readouterr().out.split())
    for words in (
        "MJCF or URDF of the robot.",
        "Link of the robot that carries it",
        "One of box, capsule, cylinder, mesh.",
        "Where the patch looks",
        "Degrees of a round side",
        "--config_path=skin.yaml",
    ):
        assert words in said
