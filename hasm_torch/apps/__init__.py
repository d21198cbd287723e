"""Command lines."""

from hasm_torch._extras import require

require("robot")
