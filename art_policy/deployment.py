"""A model without PyTorch's layers: export to ONNX, and running what was exported.

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

from art_policy.autoregressive import Autoregressive
from art_policy.layers import ARTConfig, KeyValueCache
from art_policy.multi_hypothesis import MultiHypothesis
from art_policy.sequence import ProblemBatch
from freeflyer_env.robot import FloatArray

if TYPE_CHECKING:
    from art_policy.model import ART

_INPUTS, _OUTPUTS = ("start", "goal", "discs", "final_time"), ("knots", "scores")
_MOMENT = ("state", "returns", "budget", "time_to_go")
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


def _past(config: ARTConfig) -> tuple[str, ...]:
    """Names of the keys and values of every layer: apart, so that no step has to copy them more."""
    return tuple(
        f"{what}_{layer}" for what in ("keys", "values") for layer in range(config.n_layers)
    )


def _step_inputs(config: ARTConfig) -> tuple[str, ...]:
    return (*_INPUTS, *_MOMENT, "control", "control_time", *_past(config), "known")


class _Step(nn.Module):
    """One step of an autoregressive network: the last control, then what is known before the next.

    Keys and values of a layer ``(B, heads, P, width / heads)`` are of the ``P`` tokens before;
    ``known`` ``(P + tokens of a step,)`` is False where there is nothing yet.
    """

    def __init__(self, net: Autoregressive) -> None:
        super().__init__()
        self.net = net

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(_step_inputs(self.net.config), inputs))
        net, known = self.net, given["known"]
        problems = ProblemBatch(*(given[name] for name in _INPUTS))
        moment = (given[name][:, None] for name in _MOMENT)
        state, returns, budget, time_to_go = moment
        control, control_time = given["control"][:, None], given["control_time"][:, None]
        tokens = torch.cat(
            [
                net.embed_controls(problems, control, control_time).flatten(1, 2),
                net.embed_descriptors(problems, state, returns, budget, time_to_go).flatten(1, 2),
            ],
            dim=1,
        )
        count = tokens.shape[1]
        past = known.shape[0] - count
        here = past + torch.arange(count)[:, None]
        there = torch.arange(known.shape[0])[None]
        seen = (there <= here) & (here - there < net.window) & known | (there == here)
        past_keys_values = [given[name] for name in _past(net.config)]
        layers = net.config.n_layers
        cache = KeyValueCache(past_keys_values[:layers], past_keys_values[layers:])
        for layer, block in enumerate(net.blocks):
            tokens = block(tokens, mask=seen, cache=cache, layer=layer)
        modes, logits = net.decode_controls(tokens[:, -1])
        return modes * net.control_scale, logits, *cache.keys, *cache.values


def export_onnx(model: ART, path: str | Path, int8: bool = False) -> Path:
    """Writes a model as ONNX; of an autoregressive one, a step, with keys and values of the past.

    The inputs are ``start`` and ``goal`` ``(B, 6)``, ``discs`` ``(B, M, 5)`` with rows ``(x, y,
    keep-out radius, v_x, v_y)``, radius zero for padding, and ``final_time`` ``(B,)``, float32 in
    SI units; the outputs of a multi-hypothesis model are ``knots`` ``(B, H, n_knots, 3)`` and
    ``scores`` ``(B, H)``. Any ``B`` and ``M`` do. An autoregressive model also takes what is known
    at the present step, and the keys and values of the past, which it gives back with those of the
    step added: ``_Step`` in this module says which, :class:`OnnxSteps` feeds them.

    Args:
        model: What to export.
        path: File to write; its name should end in ``.onnx``.
        int8: Whether the weights become 8-bit integers: a quarter of the size, and faster. What it
            changes in the shipped model is told on its card.

    Raises:
        ValueError: If the model sees images or scans.
        ModuleNotFoundError: Without ``onnx`` and ``onnxscript``.
    """
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
    example: tuple[Tensor, ...] = (
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
    batch, count, past = (torch.export.Dim(name) for name in ("batch", "discs", "past"))
    shapes: list[dict[int, Any]] = [{0: batch}, {0: batch}, {0: batch, 1: count}, {0: batch}]
    plain: nn.Module
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    if isinstance(model.net, MultiHypothesis):
        plain, inputs, outputs = _Plain(model.net), _INPUTS, _OUTPUTS
    else:
        config = model.config
        plain, inputs = _Step(model.net), _step_inputs(config)
        outputs = ("controls", "logits", *(f"{name}_out" for name in _past(config)))
        cached = torch.zeros(2, config.n_heads, 5, config.width // config.n_heads)
        known = torch.ones(5 + config.tokens_per_step, dtype=torch.bool)
        rows = torch.zeros(2)
        # Each input a tensor of its own: one that stood twice would be taken for one input.
        time = example[3]
        example += (example[0].clone(), rows - 0.2, rows, time.clone())
        example += (torch.zeros(2, 3), time.clone())
        example += (*(cached.clone() for _ in _past(config)), known)
        shapes += [{0: batch}] * 6 + [{0: batch, 2: past} for _ in _past(config)]
        shapes.append({0: past + config.tokens_per_step})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of axes that share a name, and of torchvision
        for name in ("torch.onnx", "onnxscript", "onnx_ir"):
            logging.getLogger(name).setLevel(logging.ERROR)
        program = torch.onnx.export(
            plain.eval(),
            example,
            dynamo=True,
            verbose=False,
            opset_version=_OPSET,
            input_names=inputs,
            output_names=outputs,
            # A forward with *inputs has one argument, a tuple.
            dynamic_shapes=(tuple(shapes),) if isinstance(plain, _Step) else tuple(shapes),
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
        # Unsigned: products of signed and unsigned bytes saturate on processors without VNNI.
        quantize_dynamic(prepared, path, weight_type=QuantType.QUInt8, per_channel=True)
    finally:
        logging.disable(logging.NOTSET)
        prepared.unlink(missing_ok=True)


class OnnxART:
    """An exported model, to be used wherever an :class:`ART` is.

    Args:
        path: What :func:`export_onnx` wrote.
        threads: Threads of ONNX Runtime.

    Attributes:
        config: Size and kind of the model.

    Raises:
        ValueError: If the file was not written by :func:`export_onnx`.
        ModuleNotFoundError: Without ``onnxruntime``.
    """

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

    def steps(self, problems: ProblemBatch, use_cache: bool = True) -> OnnxSteps:
        """One step after the other (autoregressive models), always with a cache."""
        return OnnxSteps(self._session, self.config, problems)

    def __call__(self, problems: ProblemBatch) -> tuple[Tensor, Tensor]:
        """As :meth:`MultiHypothesis.forward`."""
        knots, scores = self._session.run(list(_OUTPUTS), _arrays(problems))
        return torch.from_numpy(knots), torch.from_numpy(scores)


class OnnxSteps:
    """The steps of an exported autoregressive model."""

    def __init__(self, session: Any, config: ARTConfig, problems: ProblemBatch) -> None:
        self._session, self._tokens = session, config.tokens_per_step
        self._longest = config.context_length * config.tokens_per_step - 1
        self._inputs = _arrays(problems)
        size, head = len(problems), config.width // config.n_heads
        # The runtime dislikes empty tensors: one token that nobody sees.
        cached = np.zeros((size, config.n_heads, 1, head), dtype=np.float32)
        self._past = _past(config)
        self._inputs |= {
            **dict.fromkeys(self._past, cached),
            "known": np.zeros(1, dtype=bool),
            "control": np.zeros((size, 3), dtype=np.float32),
            "control_time": self._inputs["final_time"],
        }
        self._control_known = False

    def predict(
        self, state: FloatArray, returns: FloatArray, budget: FloatArray, time_to_go: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As :meth:`art_policy.generation.Steps.predict`."""
        inputs, tokens = self._inputs, self._tokens
        moment = zip(_MOMENT, (state, returns, budget, time_to_go))
        inputs |= {name: value.astype(np.float32) for name, value in moment}
        known = np.ones(len(inputs["known"]) + tokens, dtype=bool)
        known[:-tokens] = inputs["known"]
        known[-tokens] = self._control_known
        controls, logits, *past = self._session.run(None, {**inputs, "known": known})
        last = self._longest
        inputs |= {name: array[:, :, -last:] for name, array in zip(self._past, past)}
        inputs |= {"known": known[-last:], "control_time": inputs["time_to_go"]}
        return controls.astype(np.float64), logits

    def apply(self, control: FloatArray) -> None:
        """As :meth:`art_policy.generation.Steps.apply`."""
        self._inputs["control"], self._control_known = control.astype(np.float32), True


def _arrays(problems: ProblemBatch) -> dict[str, Any]:
    inputs = {name: getattr(problems, name).numpy() for name in _INPUTS}
    if not inputs["discs"].shape[1]:
        inputs["discs"] = np.zeros((len(problems), 1, 5), dtype=np.float32)
    return inputs
