"""The network of lumps in PyTorch (extra ``train``), its loss, and its way into an ONNX file."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from stereo_ore.stages.segment.channels import CHANNELS, STRIDE
from stereo_ore.stages.segment.outputs import OUTPUTS
from stereo_ore.types import F32

WIDTHS = (32, 64, 96, 96)
"""Features at strides 2, 4, 8 and 16."""
EVEN_AREA, SMALL_AREA = 660.0, 36.0
"""A lump of so many pixels weighs 1 a pixel; what one sees of very small ones is doubtful."""
_ORE, _LINE, _OFFSET, _SIZE = 4.0, 5.0, 2.0, 0.3
"""What the losses of ore, contact line, offset and size count."""
_NEAR = 4
"""How far around a lump [px] the ground weighs as much as the lump."""
_BESIDE = 0.2
"""What the contact line's loss counts where there is no ore."""


def _block(ins: int, outs: int, stride: int = 1) -> nn.Sequential:
    conv = nn.Conv2d(ins, outs, 3, stride, 1, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outs), nn.ReLU())


class LumpNet(nn.Module):  # type: ignore[misc]
    """An encoder and decoder with additive skips; outputs come to full size by depth-to-space.

    In (n, C, h, w), sides multiples of 16; out (n, 5, h, w) as `stages.segment.outputs` has them,
    ore and contact line as logits.
    """

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        ins = (len(CHANNELS), *widths)
        self.down = nn.ModuleList(
            nn.Sequential(_block(a, b, 2), _block(b, b)) for a, b in zip(ins, widths, strict=False)
        )
        self.middle = _block(widths[-1], widths[-1])
        self.side = nn.ModuleList(_block(b, a) for a, b in pairwise(widths))
        self.up = nn.ModuleList(_block(a, a) for a in widths[:-1])
        self.out = nn.Conv2d(widths[0], 4 * len(OUTPUTS), 3, 1, 1)
        # Depth to space as a transposed convolution: ONNX Runtime takes less than half the time.
        one = torch.eye(4).reshape(4, 1, 2, 2)
        spread = torch.zeros(4 * len(OUTPUTS), len(OUTPUTS), 2, 2)
        for k in range(len(OUTPUTS)):
            spread[4 * k : 4 * k + 4, k : k + 1] = one
        self.register_buffer("spread", spread, persistent=False)

    def forward(self, x: Any) -> Any:
        """Outputs of a batch."""
        skips = []
        for layer in self.down:
            x = layer(x)
            skips.append(x)
        x = self.middle(x)
        for i in reversed(range(len(self.up))):
            wider = functional.interpolate(self.side[i](x), scale_factor=2, mode="nearest")
            x = self.up[i](wider + skips[i])
        return functional.conv_transpose2d(self.out(x), self.spread, stride=2)


def loss_of(y: Any, t: Any) -> Any:
    """Mean loss of outputs y (n, 5, h, w) against targets t (n, 7, h, w) as `crops` makes them.

    Every lump weighs about the same, whatever its size.
    """
    ore, line, offset, size, area, inside = t[:, 0], t[:, 1], t[:, 2:4], t[:, 4], t[:, 5], t[:, 6]
    certain = inside * torch.where((area < SMALL_AREA) & (ore > 0), 0.2, 1.0)
    even = torch.where(ore > 0, EVEN_AREA / area.clamp(min=1), torch.zeros_like(area))
    weight = _beyond(even.clamp(0.25, 3) * ore) * certain
    each = even.clamp(0.05, 8) * certain

    def entropy(k: int, truth: Any) -> Any:
        return functional.binary_cross_entropy_with_logits(y[:, k], truth, reduction="none")

    def over(loss: Any) -> Any:
        return (loss * each).sum() / each.sum().clamp(min=1)

    away = functional.l1_loss(y[:, 2:4], offset, reduction="none").sum(1)
    away = away / torch.exp(size).clamp(0.2, 3).sqrt()
    sizes = functional.smooth_l1_loss(y[:, 4], size, reduction="none", beta=0.3)
    lines = (entropy(1, line) * inside * (_BESIDE + (1 - _BESIDE) * ore)).mean()
    return (
        _ORE * (entropy(0, ore) * weight).mean()
        + _LINE * lines
        + _OFFSET * over(away)
        + _SIZE * over(sizes)
    )


def restored(onnx: bytes, batches: Iterable[Any]) -> LumpNet:
    """The network of an ONNX file that `export` wrote, ready to be trained on.

    The file has batch norms folded into the convolutions. Filters get the norm 1 again, and what
    they were multiplied with and moved by goes into their batch norms, whose statistics are those
    over `batches` of channels (n, C, h, w). So outputs stay the file's, in training too.
    """
    import onnx as onnx_files

    graph = onnx_files.load_from_string(onnx).graph
    stored = {t.name: torch.tensor(onnx_files.numpy_helper.to_array(t)) for t in graph.initializer}
    net = LumpNet()
    net.eval()
    net.out.load_state_dict({name: stored[f"out.{name}"] for name in ("weight", "bias")})
    norms = []
    for name, block in net.named_modules():
        if not isinstance(block, nn.Sequential) or not isinstance(block[0], nn.Conv2d):
            continue
        weight, (conv, norm, _) = stored[f"{name}.0.weight"], block
        length = weight.flatten(1).norm(dim=1).clamp(min=1e-6)
        conv.weight.data = weight / length[:, None, None, None]
        norm.weight.data = length * (1 + norm.eps) ** 0.5
        norm.bias.data = stored[f"{name}.0.weight_bias"]
        measured = nn.BatchNorm2d(len(length), affine=False, momentum=None)
        hook = norm.register_forward_pre_hook(partial(_measure, measured))
        norms.append((norm, measured, length, hook))
    with torch.no_grad():
        for batch in batches:
            net(batch)
        for norm, measured, length, hook in norms:
            hook.remove()
            norm.load_state_dict({**norm.state_dict(), **measured.state_dict()})
            norm.weight.copy_(length * (norm.running_var + norm.eps).sqrt())
            norm.bias.add_(length * norm.running_mean)
    net.train()
    return net


def _measure(measured: Any, _norm: Any, ins: tuple[Any]) -> None:
    measured(*ins)


def _beyond(weight: Any) -> Any:
    """Weights of lumps (n, h, w), 0 elsewhere, carried on over what is near them; 1 farther off.

    An outline lies where both sides lose the same: with other weights beside a lump than in it,
    small lumps would be drawn too large and large ones too small.
    """
    near = functional.max_pool2d(weight, 2 * _NEAR + 1, 1, _NEAR)
    near = torch.where(near > 0, near, torch.ones_like(near))
    return torch.where(weight > 0, weight, near)


def outputs_of(net: nn.Module, x: F32) -> F32:
    """Outputs (5, h, w) of channels (C, h, w), ore and line as logits: what the ONNX file gives."""
    h, w = x.shape[1:]
    with torch.no_grad():
        y = net(torch.from_numpy(_padded(x))[None])[0, :, :h, :w]
        return np.asarray(y.numpy(), np.float32)


def _padded(x: F32) -> F32:
    """Channels (C, h, w) with zeros beyond, whose sides the network takes."""
    return np.pad(x, [(0, 0), (0, -x.shape[1] % STRIDE), (0, -x.shape[2] % STRIDE)])


def export(net: nn.Module, path: Path, seen: Iterable[F32]) -> None:
    """Write the network as one ONNX file of free sides; batch norms fold into the convolutions.

    Values between its layers have eight bits, over ranges that they take for channels (C, h, w)
    that it has seen (`with_ranges`).
    """
    net = net.eval().to(memory_format=torch.contiguous_format)
    x = torch.zeros(1, len(CHANNELS), 256, 320)
    sides = {2: 16 * torch.export.Dim("rows"), 3: 16 * torch.export.Dim("columns")}
    with warnings.catch_warnings():
        # The exporter warns of what its own libraries are about to change.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            net, (x,), str(path), opset_version=18, external_data=False, verbose=False,
            input_names=["channels"], output_names=["lumps"], dynamic_shapes=(sides,),
        )  # fmt: skip
    with_ranges(path, seen)


def with_ranges(path: Path, seen: Iterable[F32]) -> None:
    """Write into the file of a network which ranges its values take for channels (C, h, w).

    The engine then computes in whole numbers of eight bits, in half the time. Weights stay in the
    file as they were trained; they are rounded to seven bits, since processors without VNNI add two
    products in sixteen. The last two layers, on which a middle's place depends, are left out.
    """
    import onnx
    from onnxruntime import quantization

    class Reader(quantization.CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._left = iter(seen)

        def get_next(self) -> dict[str, F32] | None:
            x = next(self._left, None)
            return None if x is None else {"channels": _padded(x.astype(np.float32))[None]}

    model = onnx.load(path)
    # Without this mark a warning asks for a step that folds what is folded already.
    onnx.helper.set_model_props(model, {"onnx.quant.pre_process": "onnxruntime.quant"})
    layers = [node.name for node in model.graph.node if node.op_type.startswith("Conv")]
    quantization.quantize_static(
        model, path, Reader(), per_channel=True, reduce_range=True,
        activation_type=quantization.QuantType.QUInt8, weight_type=quantization.QuantType.QInt8,
        op_types_to_quantize=["Conv", "Add", "Resize", "Relu"], nodes_to_exclude=layers[-2:],
        extra_options={"AddQDQPairToWeight": True, "QuantizeBias": False},
    )  # fmt: skip
