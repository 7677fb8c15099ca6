"""The parameters of Gaussians, their shapes and encodings, and the repair of values that are not finite.

Gaussians are a mapping from the names below to tensors that share their first dimension N. Values are stored before
activation, as 3DGS and splatfacto do:

=================  ==============  ===============================================================
name               shape           meaning
=================  ==============  ===============================================================
``means``          ``[N, 3]``      centres, world units
``scales``         ``[N, 3]``      log of the standard deviations, world units
``quats``          ``[N, 4]``      rotation as wxyz quaternion, not normalised
``features_dc``    ``[N, 3]``      spherical harmonics, degree 0
``features_rest``  ``[N, K, 3]``   spherical harmonics, degrees 1 and up
``opacities``      ``[N, 1]``      logit of the opacity
``features``       ``[N, F]``      splatted feature vectors (c_i in the paper's neural image); optional
=================  ==============  ===============================================================
"""

from __future__ import annotations

from collections import UserDict
from collections.abc import Mapping, MutableMapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from sundae_ns.core.errors import DataError
from sundae_ns.core.values import floats, positions

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
Encoding = Literal["harmonics", "logits"]
"""``harmonics``: ``features_dc`` and ``features_rest`` are coefficients of spherical harmonics. ``logits``:
``features_dc`` holds logits of view-independent colours, as splatfacto does at SH degree 0."""
SPLAT_NAMES = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")  # named as in splatfacto
_COLUMNS = {"means": 3, "scales": 3, "quats": 4, "features_dc": 3, "opacities": 1}
MAX_SH_DEGREE = 4
FEATURES = "features"  # name of the parameter that SUNDAE adds to each Gaussian
LARGEST_LOGIT = 16.0  # for opacities of 0 and 1; its float32 opacity is the last below 1
LEAST_SCALES = (-80.0, -43.0)  # limits of the log-scale for widths of 0; squares of the larger one are normal float32


def num_gaussians(params: Mapping[str, Tensor]) -> int:
    """Number of Gaussians N."""
    return params["means"].shape[0]


def sh_degree(features_rest: Tensor) -> int:
    """SH degree of coefficients ``[N, K, 3]`` of degrees 1 and up, K = (degree + 1)^2 - 1."""
    return round((features_rest.shape[1] + 1) ** 0.5) - 1


def sh_degree_of(coefficients: int) -> int | None:
    """SH degree with (degree + 1)^2 - 1 = ``coefficients`` per channel of degrees 1 and up; None if no degree has."""
    return next((d for d in range(MAX_SH_DEGREE + 1) if (d + 1) ** 2 - 1 == coefficients), None)


def odd_shapes(params: Mapping[str, Tensor]) -> list[str]:
    """Descriptions of the parameters with a wrong shape, for an error message; N is the length of ``means``."""
    n = params["means"].shape[0] if params["means"].ndim else 0
    rest = params["features_rest"].shape
    known = len(rest) > 1 and sh_degree_of(rest[1]) is not None
    wanted: dict[str, tuple[int | str, ...]] = {name: (n, columns) for name, columns in _COLUMNS.items()}
    wanted["features_rest"] = (n, rest[1] if known else "(degree + 1)^2 - 1", 3)
    if FEATURES in params:
        wanted[FEATURES] = (n, params[FEATURES].shape[-1] if params[FEATURES].ndim else "F")
    return [
        f"{name} has shape {list(params[name].shape)}; it must be [{', '.join(map(str, shape))}]"
        for name, shape in wanted.items()
        if tuple(params[name].shape) != shape
    ]


def rgb_to_sh(rgb: Tensor) -> Tensor:
    """SH coefficient of degree 0 ``[..., 3]`` of a colour in [0, 1]."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(sh: Tensor) -> Tensor:
    """View-independent colour ``[..., 3]`` of an SH coefficient of degree 0 ``[..., 3]``; not clamped."""
    return sh * SH_C0 + 0.5


def rgb_to_logit(rgb: Tensor) -> Tensor:
    """Logit ``[..., 3]`` of a colour ``[..., 3]``, clamped to [0.001, 0.999]."""
    return torch.logit(rgb.clamp(1e-3, 1 - 1e-3))


def finite_mask(params: Mapping[str, Tensor]) -> Tensor:
    """True where every parameter of a Gaussian is finite: bool ``[N]``."""
    # A sum that is finite is one of finite numbers. Products with 0 are 0 or NaN; tests of each number take longer.
    if all(value.is_cpu and bool(value.detach().sum().isfinite()) for value in params.values()):
        return torch.ones(num_gaussians(params), dtype=torch.bool)
    return torch.stack([(value.detach().flatten(1) * 0).sum(dim=1) == 0 for value in params.values()]).all(dim=0)


class Gaussians(UserDict[str, Any]):
    """Named parameters ``[N, ...]`` (see :mod:`sundae_ns.core.gaussians`) and the encoding of their colours.

    Wraps the given mapping without a copy: surgery that replaces a parameter here replaces it there too. ``len`` counts
    parameters, :attr:`num_gaussians` counts Gaussians.
    """

    def __init__(self, params: MutableMapping[str, Any], encoding: Encoding = "harmonics") -> None:
        # Not by UserDict, which would copy the mapping.
        self.data = params  # type: ignore[assignment]
        self.encoding: Encoding = encoding

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians N."""
        return num_gaussians(self)

    @property
    def sh_degree(self) -> int:
        """SH degree of the stored colours."""
        return sh_degree(self["features_rest"])

    def rows(self, index: Tensor) -> Gaussians:
        """The Gaussians under a mask, bool ``[N]``, or of indices ``[M]``, in a new mapping."""
        indices = torch.arange(self.num_gaussians, device=self["means"].device)[index]  # a mask is searched once
        return Gaussians({name: value.index_select(0, indices) for name, value in self.items()}, self.encoding)

    def replaced(self, values: Mapping[str, Tensor]) -> Gaussians:
        """The same tensors except for these values, in a new mapping that surgery does not change."""
        return Gaussians({**self, **values}, self.encoding)

    def to(self, device: torch.device | str) -> Gaussians:
        """The Gaussians on another device, in a new mapping."""
        return self.replaced({name: value.to(device) for name, value in self.items()})

    def as_harmonics(self) -> Gaussians:
        """The Gaussians with colours as spherical harmonics, detached; itself if they are stored so."""
        if self.encoding == "harmonics":
            return self
        return Gaussians({**self, "features_dc": rgb_to_sh(self["features_dc"].detach().sigmoid())}, "harmonics")


def concatenated(parts: Sequence[Mapping[str, Tensor]], names: Sequence[str] = SPLAT_NAMES) -> dict[str, Tensor]:
    """Parameters of the Gaussians of one or more parts ``[N, ...]``, by name; missing SH degrees are zero."""
    most = max(part["features_rest"].shape[1] for part in parts)
    lists = {name: [part[name] for part in parts] for name in names}
    lists["features_rest"] = [torch.nn.functional.pad(r, (0, 0, 0, most - r.shape[1])) for r in lists["features_rest"]]
    return {name: torch.cat(tensors) for name, tensors in lists.items()}


def as_gaussians(params: Mapping[str, Any]) -> Gaussians:
    """A mapping of parameters as :class:`Gaussians`; a plain mapping stores colours as harmonics."""
    return params if isinstance(params, Gaussians) else Gaussians(dict(params))


def checked(params: Mapping[str, Any]) -> Gaussians:
    """Parameters of a caller, lists and arrays too, as float32 tensors; ``DataError`` for all that is no Gaussian."""
    names = params.keys() if isinstance(params, Mapping) else set()
    if odd := sorted(str(name) for name in (names ^ set(SPLAT_NAMES)) - {FEATURES}):
        raise DataError(f"missing or unknown: {', '.join(odd)}; Gaussians map {', '.join(SPLAT_NAMES)} to tensors")
    gaussians = as_gaussians(params)
    values = {name: (positions if name == "means" else floats)(value, name) for name, value in gaussians.items()}
    if faults := odd_shapes(values):
        raise DataError(faults[0])
    if not num_gaussians(values):
        raise DataError("there are no Gaussians; give at least one")
    if len(devices := {str(value.device) for value in values.values()}) > 1 or "meta" in devices:
        raise DataError(f"the Gaussians are on {' and '.join(sorted(devices))}; move them to one that holds values")
    limits = [limit for value in values.values() if value.numel() for limit in value.detach().aminmax()]
    if not bool(torch.stack(limits).isfinite().all()):
        if wrong := sanitise(values).dropped:
            raise DataError(f"{wrong:,} of {num_gaussians(values):,} Gaussians are NaN or infinite; remove these rows")
    if not values["quats"].requires_grad and bool((values["quats"].abs().amax(dim=1).log10().abs() > 6).any()):
        values["quats"] = sanitise(values).gaussians["quats"]  # which rasterisers can normalise
    return gaussians if all(values[name] is value for name, value in gaussians.items()) else gaussians.replaced(values)


class Sanitised(NamedTuple):
    """Gaussians whose values are finite, and what was changed."""

    gaussians: Gaussians  # the valid ones [M, ...]; the tensors of the source if nothing changed
    mask: Tensor  # True for these Gaussians of the source, bool [N]
    limits: int  # number of them with an opacity of exactly 0 or 1, which was clamped
    flat: int  # with a width of 0, which was clamped
    unrotated: int  # with an all-zero quaternion, which became the identity

    @property
    def dropped(self) -> int:
        """Number of Gaussians that were dropped: NaN, or infinite where that has no meaning."""
        return len(self.mask) - self.gaussians.num_gaussians

    @property
    def clamped(self) -> bool:
        """Whether a value was replaced."""
        return self.limits + self.flat + self.unrotated > 0

    def summary(self) -> str:
        """A clause that counts clamped and dropped Gaussians; empty if nothing was changed."""
        kinds = {"opacity 0 or 1": self.limits, "width 0": self.flat, "rotation 0": self.unrotated}
        named = " and ".join(f"{number:,} with {name}" for name, number in kinds.items() if number)
        parts = [f"clamped {named} to finite values"] if named else []
        parts += [f"dropped {self.dropped:,} that were not finite (NaN or infinite)"] if self.dropped else []
        return f"{len(self.mask):,} Gaussians: {', '.join(parts)}" if parts else ""


@torch.no_grad()
def sanitise(params: Mapping[str, Any]) -> Sanitised:
    """The valid Gaussians, with finite values; ``params`` does not change.

    - A logit of plus or minus infinity is an opacity of 1 or 0, and becomes plus or minus :data:`LARGEST_LOGIT`.
    - A log-scale of minus infinity is a width of 0, and becomes the least scale within :data:`LEAST_SCALES`.
    - An all-zero quaternion becomes the identity; one that cannot be normalised in float32 is rescaled.
    - A Gaussian with any other value that is NaN or infinite is dropped.
    """
    gaussians = as_gaussians(params)
    values: dict[str, Tensor] = {}
    opacities, scales, quats = (gaussians[name].detach() for name in ("opacities", "scales", "quats"))
    infinite, narrow = opacities.isinf(), scales.isneginf()
    limits, flat = infinite.flatten(1).any(dim=1), narrow.any(dim=1)
    unrotated = torch.zeros_like(flat)
    if bool(limits.any()):
        values["opacities"] = torch.where(infinite, opacities.clamp(-LARGEST_LOGIT, LARGEST_LOGIT), opacities)
    if bool(flat.any()):
        narrowest = torch.where(scales.isfinite(), scales, LEAST_SCALES[1]).amin().clamp(*LEAST_SCALES)
        values["scales"] = torch.where(narrow, narrowest, scales)
    if gaussians.num_gaussians:
        largest = quats.abs().amax(dim=1)
        odd = ((largest < 1e-6) | (largest > 1e18)) & largest.isfinite()
        if bool(odd.any()):
            unrotated = largest == 0
            rescaled = quats / torch.where(odd, largest, 1.0).clamp_min(torch.finfo(quats.dtype).tiny)[:, None]
            rescaled[:, 0] += unrotated.to(rescaled)  # the identity: w is 1, the others stay 0
            values["quats"] = torch.where(odd[:, None], rescaled, quats)
    sanitised = gaussians.replaced(values) if values else gaussians
    mask = finite_mask(sanitised)
    counts = (int((kind & mask).sum()) for kind in (limits, flat, unrotated))
    return Sanitised(sanitised if bool(mask.all()) else sanitised.rows(mask), mask, *counts)


def bytes_of(params: Mapping[str, Tensor]) -> int:
    """Bytes of the parameters of Gaussians in fp32, feature vectors included, for any dtype in memory."""
    return sum(value.numel() for value in params.values()) * 4
