"""Console scripts: what is missing for one ends it in a sentence, not in a traceback."""

import sys
from importlib import import_module


def _run(app: str) -> None:
    try:
        module = import_module(f"hasm_torch.apps.{app}")
    except ModuleNotFoundError as error:
        sys.exit(f"{sys.argv[0].rpartition('/')[2]}: {error}")
    module.main()


def train() -> None:
    """``hasm-train``."""
    _run("training")


def evaluate() -> None:
    """``hasm-eval``."""
    _run("evaluation")


def touch() -> None:
    """``hasm-touch``."""
    _run("touch")


def record() -> None:
    """``hasm-record``."""
    _run("record")


def import_bags() -> None:
    """``hasm-import``."""
    _run("import_bags")


def skin() -> None:
    """``hasm-skin``."""
    _run("skin")
