"""Inner products of single channels' place codes, looked up instead of computed.

The range of a channel falls into cells of positions that share one code, so the inner product of
two codes is an entry of one table (cells, cells).
"""

import torch
from torch import Tensor, nn

from hasm_torch.encoders.place_code import PlaceCode


class OwnCodes(nn.Module):
    """Cells of places, and the table of their codes' inner products.

    Args:
        place_code: The code of all channels.
    """

    powers: Tensor
    keys: Tensor
    table: Tensor

    def __init__(self, place_code: PlaceCode) -> None:
        super().__init__()
        code = place_code
        single = PlaceCode([0.0], [1.0], code.neurons, code.bits, code.width, code.code)
        steps = (code.bits if code.code == "thermometer" else 2**code.bits) + 1
        # Modulo 2^62 where neurons are many: two codes then share a number by chance alone.
        powers = [pow(steps, neuron, 2**62) for neuron in range(code.neurons)]
        self.register_buffer("powers", torch.tensor(powers))
        keys, order = self._keys(single.levels(single.cell_positions.unsqueeze(-1))).sort()
        codes = single.cell_codes[order]
        self.register_buffer("keys", keys)
        self.register_buffer("table", (codes @ codes.mT).to(torch.int16))

    def _keys(self, levels: Tensor) -> Tensor:
        """One number for the levels (..., neurons) of a code."""
        return (levels.long() * self.powers).sum(-1)

    def cells(self, levels: Tensor) -> Tensor:
        """The cell of each place.

        Args:
            levels: (..., neurons), from ``PlaceCode.levels``.

        Returns:
            (...,) int64.
        """
        found = torch.searchsorted(self.keys, self._keys(levels))
        return found.clamp(max=len(self.keys) - 1)

    def products(self, queries: Tensor, stored: Tensor) -> Tensor:
        """Inner products of the codes of cells; the shapes broadcast, the result is int16."""
        return self.table.flatten()[queries * len(self.keys) + stored]
