"""``policy.h``: the policy as one C99 header without dependencies, and a program that checks it."""

from __future__ import annotations

import hashlib
import itertools
import string
from typing import TYPE_CHECKING

import numpy as np

from naosprint.export.arrays import policy_arrays

if TYPE_CHECKING:
    from naosprint.arrays import AnyArray, FloatArray
    from naosprint.rl.checkpoint import Manifest
    from naosprint.rl.policy import NetworkPolicy

TOLERANCE = 1e-6
"""Largest difference of an action between the header and the checkpoint."""

DEFAULT_NAME = "policy"
"""Name of an exported policy, unless another is given."""

_VECTORS = 64
_PLAIN_CHARACTERS = frozenset(string.ascii_letters + string.digits + " _.,:+-")
_WIDTH = 8

_GUARD = """\
#ifndef NAOSPRINT_{upper}_{policy}
#ifdef NAOSPRINT_{upper}_H
#error "Another policy.h is included here already: export one of them with another --name."
#endif
#define NAOSPRINT_{upper}_H
#define NAOSPRINT_{upper}_{policy}
"""

_CODE = """\
/* Compute the actions, in [-1, 1], of raw observations, and return 1. If an observation is not finite, the actions stay
   as they are, and it returns 0: initialize them with those before the first cycle, such as zeros. */
static inline int policy_act(const double observations[POLICY_OBSERVATIONS], double actions[POLICY_ACTIONS])
{
    double z0[POLICY_WIDEST], z1[POLICY_WIDEST], *in = z0, *out = z1, *swap;
    int i;
    for (i = 0; i < POLICY_OBSERVATIONS; i++)
        if (!isfinite(observations[i]))
            return 0;
    for (i = 0; i < POLICY_OBSERVATIONS; i++) {
        in[i] = (observations[i] - policy_mean[i]) * policy_scale[i];
#ifdef POLICY_CLIP
        in[i] = fmin(fmax(in[i], -POLICY_CLIP), POLICY_CLIP);
#endif
    }
%(layers)s
    for (i = 0; i < POLICY_ACTIONS; i++)
        actions[i] = fmin(fmax(in[i], -1.0), 1.0);
    return 1;
}

/* Compute the target angles of all joints in radians, in the simulator's order and signs. */
static inline void policy_targets(const double actions[POLICY_ACTIONS], double targets[POLICY_JOINTS])
{
    int i, k;
    for (i = 0; i < POLICY_JOINTS; i++) {
        double sum = policy_middle_rad[i];
        for (k = 0; k < POLICY_ACTIONS; k++)
            sum += policy_reach_rad[i * POLICY_ACTIONS + k] * actions[k];
        targets[i] = fmin(fmax(sum, policy_low_rad[i]), policy_high_rad[i]);
    }
}
"""

_LAYER = "    policy_layer(policy_weights_{i}, policy_bias_{i}, {rows}, {columns}, {function}, in, out);\n    {swap}"
_SWAP = "swap = in, in = out, out = swap;"

_FUNCTIONS = ("linear", "relu", "tanh")
"""Functions after a layer, by their numbers in the header."""

_LINEAR = """\
static inline void policy_layer(const float *weights, const float *bias, int rows, int columns, int function,
                                const double *in, double *out)
{
    int row, column;
    for (row = 0; row < rows; row++) {
        double sum = bias[row];
        for (column = 0; column < columns; column++)
            sum += (double)weights[row * columns + column] * in[column];
        out[row] = function == 2 ? tanh(sum) : function == 1 ? fmax(sum, 0.0) : sum;
    }
}
"""

_CHECK = """\
/* Compare policy.h with the checkpoint it was made from: cc -std=c99 policy_check.c -lm && ./a.out */
#include <stdio.h>
#include "policy.h"

#define VECTORS %(count)d

%(observations)s
%(actions)s
int main(void)
{
    double actions[POLICY_ACTIONS] = {0.0}, worst = 0.0;
    int n, i;
    for (n = 0; n < VECTORS; n++) {
        if (!policy_act(observations + n * POLICY_OBSERVATIONS, actions))
            return 1;
        for (i = 0; i < POLICY_ACTIONS; i++)
            worst = fmax(worst, fabs(actions[i] - expected[n * POLICY_ACTIONS + i]));
    }
    printf("%%d vectors, largest difference %%.3g\\n", VECTORS, worst);
    return worst <= %(tolerance)g ? 0 : 1;
}
"""


def build_header(policy: NetworkPolicy, manifest: Manifest, name: str = DEFAULT_NAME) -> str:
    """Return the text of ``policy.h``: weights, standardization, ranges of the joints, and functions.

    All that it defines begins with ``name``, so that several policies can be part of one program.
    """
    arrays = policy_arrays(policy, manifest)
    digest = hashlib.sha256(manifest.spec_sha256.encode())
    for values in (policy.mean, policy.scale, *itertools.chain(*policy.layers)):
        digest.update(np.ascontiguousarray(values).tobytes())
    policy_id = digest.hexdigest()[:16].upper()
    joints = len(arrays["joint_names"])
    widest = max(len(policy.mean), *(len(bias) for _, bias in policy.layers))
    lines = [
        f"/* Policy of {_text(str(arrays['robot']))}, {manifest.steps} steps of training. Exported by naosprint. */",
        *_named(_GUARD, name).format(policy=policy_id, upper=name.upper()).splitlines(),
        "",
        "#include <math.h>",
        "",
        f"#define {name.upper()}_OBSERVATIONS {len(policy.mean)}",
        f"#define {name.upper()}_ACTIONS {policy.n_actions}",
        f"#define {name.upper()}_JOINTS {joints}",
        f"#define {name.upper()}_WIDEST {widest}",
        f"#define {name.upper()}_CYCLE_S {float(arrays['cycle_s'])!r}",
    ]
    if np.isfinite(policy.clip):
        lines.append(f"#define {name.upper()}_CLIP {float(policy.clip)!r}")
    lines += [
        "",
        _names(f"{name}_observation_names", manifest.observations),
        _names(f"{name}_action_names", manifest.actions),
        _names(f"{name}_joint_names", [str(name) for name in arrays["joint_names"]]),
    ]
    tables: dict[str, AnyArray] = {"mean": policy.mean, "scale": policy.scale}
    tables |= {table: arrays[table] for table in ("middle_rad", "reach_rad", "low_rad", "high_rad")}
    lines += [_array(f"{name}_{table}", values) for table, values in tables.items()]
    calls = []
    for i, (weights, bias) in enumerate(policy.layers):
        lines += [_array(f"{name}_weights_{i}", weights), _array(f"{name}_bias_{i}", bias)]
        rows, columns = weights.shape
        function = _FUNCTIONS.index(policy.activations[i])
        calls.append(_named(_LAYER, name).format(i=i, rows=rows, columns=columns, function=function, swap=_SWAP))
    return "\n".join([*lines, _named(_LINEAR, name), _named(_CODE, name) % {"layers": "\n".join(calls)}, "#endif", ""])


def build_check(policy: NetworkPolicy, name: str = DEFAULT_NAME) -> str:
    """Return the text of ``policy_check.c``, a program that compares ``policy.h`` with values of the checkpoint."""
    observations = parity_observations(policy)
    expected = exact_actions(policy, observations)
    return _named(_CHECK, name) % {
        "count": len(observations),
        "observations": _array("observations", observations),
        "actions": _array("expected", expected),
        "tolerance": TOLERANCE,
    }


def parity_observations(policy: NetworkPolicy) -> FloatArray:
    """Return (n, D) observations spread as widely as the policy has seen them, and beyond."""
    rng = np.random.default_rng(0)
    spread = 2.0 * rng.standard_normal((_VECTORS, len(policy.mean)))
    return np.asarray(policy.mean + spread / np.minimum(policy.scale, 1e3))


def exact_actions(policy: NetworkPolicy, observations: FloatArray) -> FloatArray:
    """Return (n, A) actions computed from the checkpoint's weights in double precision."""
    hidden = np.clip((observations - policy.mean) * policy.scale, -policy.clip, policy.clip)
    for (weights, bias), function in zip(policy.layers, policy.activations, strict=True):
        hidden = hidden @ weights.T.astype(np.float64) + bias.astype(np.float64)
        if function != "linear":
            hidden = np.tanh(hidden) if function == "tanh" else np.maximum(hidden, 0.0)
    return np.clip(hidden, -1.0, 1.0)


def _named(template: str, name: str) -> str:
    """Return C code whose names begin with ``name`` instead of ``policy``."""
    code = template.replace("policy_", f"{name}_").replace("POLICY_", f"{name.upper()}_")
    return code.replace("policy.h", f"{name}.h")


def _names(name: str, values: tuple[str, ...] | list[str]) -> str:
    return f"static const char *const {name}[] = {{\n" + "".join(f'    "{_text(value)}",\n' for value in values) + "};"


def _text(value: str) -> str:
    """Return text for a C string or comment: all but letters, digits, spaces and ``_.,:+-`` as octal escapes."""
    return "".join(
        chr(byte) if chr(byte) in _PLAIN_CHARACTERS else f"\\{byte:03o}"
        for byte in value.encode("utf-8", "surrogatepass")
    )


def _array(name: str, values: AnyArray) -> str:
    """Return the definition of a constant array, row by row, with all digits."""
    single = values.dtype == np.float32
    kind = "float" if single else "double"
    texts = [f"{v:.9g}" if single else repr(float(v)) for v in values.ravel()]
    words = [(text if any(c in text for c in ".en") else f"{text}.0") + ("f" if single else "") for text in texts]
    rows = [", ".join(words[i : i + _WIDTH]) for i in range(0, len(words), _WIDTH)]
    return f"static const {kind} {name}[] = {{\n    " + ",\n    ".join(rows) + "};"
