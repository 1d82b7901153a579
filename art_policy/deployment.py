"""A model without PyTorch: export to ONNX, and running what was exported.

ONNX Runtime is small, runs on what on-board computers have, and on one processor core is faster
than PyTorch for a single problem.
"""

from __future__ import annotations

import json
import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from art_policy.layers import ARTConfig
from art_policy.multi_hypothesis import MultiHypothesis
from art_policy.sequence import ProblemBatch

if TYPE_CHECKING:
    from art_policy.model import ART

_INPUTS, _OUTPUTS = ("start", "goal", "discs", "final_time"), ("knots", "scores")
_CONFIG_KEY = "art_config"
_OPSET = 18


class _Plain(nn.Module):
    """The network with tensors for arguments."""

    def __init__(self, net: MultiHypothesis) -> None:
        super().__init__()
        self.net = net

    def forward(
        self, start: Tensor, goal: Tensor, discs: Tensor, final_time: Tensor
    ) -> tuple[Tensor, Tensor]:
        return self.net(ProblemBatch(start, goal, discs, final_time))


def export_onnx(model: ART, path: str | Path, int8: bool = False) -> Path:
    """Writes a multi-hypothesis model as ONNX.

    Inputs are ``start`` and ``goal`` ``(B, 6)``, ``discs`` ``(B, M, 5)`` with rows ``(x, y,
    keep-out radius, v_x, v_y)``, radius zero for padding, and ``final_time`` ``(B,)``, float32 in
    SI units; outputs are ``knots`` ``(B, H, n_knots, 3)`` and ``scores`` ``(B, H)``. Any ``B`` and
    ``M`` do.

    Args:
        model: What to export.
        path: File to write; its name should end in ``.onnx``.
        int8: Whether the weights become 8-bit integers: a quarter of the size, and faster. What it
            changes in the shipped model is told on its card.

    Raises:
        ValueError: If the model is autoregressive, whose generation is a loop over steps.
        ModuleNotFoundError: Without ``onnx`` and ``onnxscript``.
    """
    if not isinstance(model.net, MultiHypothesis):
        raise ValueError("Only multi-hypothesis models can be exported; this one generates steps.")
    if model.config.modalities != ("vector",):
        raise ValueError("Only models that know the discs can be exported; this one sees images.")
    try:
        import onnx
        import onnxscript  # noqa: F401  what torch exports with
    except ImportError as error:
        raise ModuleNotFoundError(
            'The export needs ONNX: pip install "freeflyer-gym[onnx]".'
        ) from error
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Two problems, one with padding, so that nothing is taken for a constant.
    example = (
        torch.tensor([[0.3, 1.0, 0.1, 0.0, 0.0, 0.0], [0.2, 2.0, 1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[3.2, 1.5, 0.5, 0.0, 0.0, 0.0], [3.3, 0.5, 2.0, 0.0, 0.0, 0.0]]),
        torch.tensor(
            [
                [[1.0, 1.0, 0.3, 0.0, 0.01], [2.0, 1.2, 0.4, 0.0, 0.0], [0.0] * 5],
                [[1.5, 1.0, 0.3, 0.01, 0.0]] * 3,
            ]
        ),
        torch.tensor([40.0, 60.0]),
    )
    batch, count = torch.export.Dim("batch"), torch.export.Dim("discs")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of axes that share a name, and of torchvision
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            _Plain(model.net).eval(),
            example,
            dynamo=True,
            verbose=False,
            opset_version=_OPSET,
            input_names=_INPUTS,
            output_names=_OUTPUTS,
            dynamic_shapes={
                "start": {0: batch},
                "goal": {0: batch},
                "discs": {0: batch, 1: count},
                "final_time": {0: batch},
            },
        )
    assert program is not None
    proto = program.model_proto
    entry = proto.metadata_props.add()
    entry.key, entry.value = _CONFIG_KEY, json.dumps(model.config.to_dict())
    onnx.save(proto, path)
    if int8:
        _quantise(path)
    return path


def _quantise(path: Path) -> None:
    """Turns the weights of an exported model into 8-bit integers, in place."""
    from onnxruntime.quantization import QuantType, quantize_dynamic
    from onnxruntime.quantization.shape_inference import quant_pre_process

    prepared = path.with_suffix(".prepared.onnx")
    logging.disable(logging.WARNING)  # it has no say in what is not quantised
    try:
        quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
        quantize_dynamic(prepared, path, weight_type=QuantType.QInt8, per_channel=True)
    finally:
        logging.disable(logging.NOTSET)
        prepared.unlink(missing_ok=True)


class OnnxART:
    """An exported model, to be used wherever a multi-hypothesis :class:`ART` is.

    Args:
        path: What :func:`export_onnx` wrote.
        threads: Threads of ONNX Runtime.

    Attributes:
        config: Size and kind of the model.

    Raises:
        ValueError: If the file was not written by :func:`export_onnx`.
        ModuleNotFoundError: Without ``onnxruntime``.
    """

    net = None
    device = torch.device("cpu")

    def __init__(self, path: str | Path, threads: int = 1) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise ModuleNotFoundError(
                'An ONNX model needs its runtime: pip install "freeflyer-gym[onnx]".'
            ) from error
        if not Path(path).is_file():
            raise FileNotFoundError(f"There is no file {str(path)!r}.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self._session: Any = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # the runtime has a class for each code of its own
            raise ValueError(f"{str(path)!r} is not an ONNX model that runs: {error}") from error
        metadata = self._session.get_modelmeta().custom_metadata_map
        if _CONFIG_KEY not in metadata:
            raise ValueError(f"{str(path)!r} was not written by freeflyer export.")
        self.config = ARTConfig.from_dict(json.loads(metadata[_CONFIG_KEY]))

    def __call__(self, problems: ProblemBatch) -> tuple[Tensor, Tensor]:
        """As :meth:`MultiHypothesis.forward`."""
        inputs = {name: getattr(problems, name).numpy() for name in _INPUTS}
        if not inputs["discs"].shape[1]:
            inputs["discs"] = np.zeros((len(problems), 1, 5), dtype=np.float32)
        knots, scores = self._session.run(list(_OUTPUTS), inputs)
        return torch.from_numpy(knots), torch.from_numpy(scores)
