"""Write the trees of the robots beside this file, and factorisation, solve and product of their sparse matrices.

Developers run it after a change of a tree: ``python packages/naosim/cpp/topology.py``. Rows are eliminated from last
to first in every pattern, and sums are split by the parity of the index: an entry that is zero in a sparser pattern
changes no bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from naosim.mujoco.world import FEET, PREFIX, compiled

SIDES = ("Left", "Right")
ARMS = (
    *("AL1", "AL2", "AL3", "AR1", "AR2", "AR3", "left_hand_link", "right_hand_link"),
    *(f"{side}_Arm_{number}" for side in SIDES for number in (1, 2, 3)),
)
HIPS = (
    "Waist",
    *(f"Hip_{part}_{side}" for side in SIDES for part in ("Pitch", "Roll")),
    *(f"{side}_Hip_{part}" for side in SIDES for part in ("Pitch", "Roll", "Yaw")),
)
"""Bodies between hands and thighs, whose contacts get a pattern of their own."""

Pattern = list[set[int]]
"""Columns below the diagonal, row by row."""


@dataclass(frozen=True)
class Tree:
    """What of a robot is known at compile time.

    Attributes:
        parents: parent of each body; -1 for the torso.
        axes: 0, 1 or 2: the axis of each body's hinge.
        feet: left and right foot.
        geom_bodies: body of each geom.
        geom_shapes: ``mjtGeom`` of each geom.
        arms: bodies of the arms.
        hips: bodies between torso and thighs, these included.
    """

    parents: list[int]
    axes: list[int]
    feet: list[int]
    geom_bodies: list[int]
    geom_shapes: list[int]
    arms: list[int]
    hips: list[int]

    @property
    def speeds(self) -> int:
        """Number of the robot's speeds."""
        return len(self.parents) + 5

    def mass(self) -> Pattern:
        """Return the sparsity of the inertia matrix: a joint, its ancestors and the free joint."""
        rows: Pattern = []
        for i in range(self.speeds):
            row, body = set(range(min(i, 6))), self.parents[i - 5] if i >= 6 else 0
            while body > 0:
                row.add(body + 5)
                body = self.parents[body]
            rows.append(row)
        return rows

    def crossed(self) -> Pattern:
        """Return the sparsity with contacts of hands and thighs, and the fill of its elimination."""
        rows = self.mass()
        for i in self.hips:
            rows[i + 5] |= {j + 5 for j in self.arms}
        for k in reversed(range(self.speeds)):
            for i in rows[k]:
                rows[i] |= {j for j in rows[k] if j < i}
        return rows


def tree_of(robot: str) -> Tree:
    """Return the tree of ``T1`` or ``K1``."""
    model = compiled(robot, engine="fast").model
    names = [model.body(body).name.removeprefix(PREFIX) for body in range(1, model.nbody)]
    return Tree(
        parents=[int(parent) - 1 for parent in model.body_parentid[1:]],
        axes=[0, *np.argmax(model.jnt_axis[1:], axis=1).tolist()],
        feet=[names.index(foot) for foot in FEET],
        geom_bodies=[int(body) - 1 for body in model.geom_bodyid[1:]],
        geom_shapes=model.geom_type[1:].tolist(),
        arms=[body for body, name in enumerate(names) if name in ARMS],
        hips=[body for body, name in enumerate(names) if name in HIPS],
    )


def at(i: int, j: int) -> int:
    """Return the index of an entry of the packed lower triangle."""
    return i * (i + 1) // 2 + j


def below(rows: Pattern, i: int) -> list[int]:
    """Return the rows with an entry in column i, last first."""
    return [k for k in reversed(range(len(rows))) if i in rows[k]]


def subtract(i: int, terms: list[tuple[int, int]]) -> str:
    """Return the code of ``x[i] -= sum of H[entry] x[k]``."""
    even = "".join(f" s -= H[{entry}] * x[{k}];" for entry, k in terms if k % 2 == 0)
    odd = "".join(f" t += H[{entry}] * x[{k}];" for entry, k in terms if k % 2)
    return f"  {{ Real s = x[{i}], t = splat(0);{even}{odd} x[{i}] = s - t; }}"


def factor(name: str, rows: Pattern) -> list[str]:
    """Return the code of H = L^T D L in place and of 1 / D."""
    code = [f"inline void factor_{name}(Real* __restrict H, Real* __restrict inv) {{", f"  Real D[{len(rows)}];"]
    for i in reversed(range(len(rows))):
        columns = [*sorted(rows[i]), i]
        code += ["  {", "    Real " + ", ".join(f"a{j} = H[{at(i, j)}]" for j in columns) + ";"]
        for k in below(rows, i):
            terms = " ".join(f"a{j} -= f * H[{at(k, j)}];" for j in columns if j in rows[k])
            code.append(f"    {{ const Real f = H[{at(k, i)}] * D[{k}]; {terms} }}")
        code.append(f"    const Real iv = 1.0 / a{i}; D[{i}] = a{i}; inv[{i}] = iv;")
        code += ["    " + " ".join(f"H[{at(i, j)}] = a{j} * iv;" for j in columns[:-1]), "  }"]
    return [*code, "}"]


def solve(name: str, rows: Pattern) -> list[str]:
    """Return the code of L^T D L x = b, b in x."""
    size = len(rows)
    code = [f"inline void solve_{name}(const Real* __restrict H, const Real* __restrict inv, Real* __restrict x) {{"]
    code += [subtract(i, [(at(k, i), k) for k in below(rows, i)]) for i in reversed(range(size)) if below(rows, i)]
    code.append(f"  for (int i = 0; i < {size}; ++i) x[i] *= inv[i];")
    code += [subtract(i, [(at(i, k), k) for k in sorted(rows[i])]) for i in range(size) if rows[i]]
    return [*code, "}"]


def multiply(rows: Pattern) -> list[str]:
    """Return the code of y = M x."""
    code = ["inline void mul_tree(const Real* __restrict M, const Real* __restrict x, Real* __restrict y) {"]
    for i in range(len(rows)):
        terms = [(at(i, j), j) for j in [*sorted(rows[i]), i]] + [(at(k, i), k) for k in reversed(below(rows, i))]
        half = len(terms) // 2
        sums = " + ".join(
            f"({' + '.join(f'M[{a}] * x[{b}]' for a, b in part)})" for part in (terms[:half], terms[half:]) if part
        )
        code.append(f"  y[{i}] = {sums};")
    return [*code, "}"]


def matrices(tree: Tree) -> list[str]:
    """Return the code for a tree's matrices."""
    m, filled = tree.mass(), tree.crossed()
    code = ["// Written by topology.py; included by humanoid_dynamics.hpp within its namespace."]
    for name, rows in (("tree", m), ("arms", filled)):
        code += [*factor(name, rows), *solve(name, rows)]
    code += [*multiply(m), "inline void copy_tree_fast(const Real* __restrict a, Real* __restrict b) {"]
    code += [f"  b[{at(i, j)}] = a[{at(i, j)}];" for i in range(tree.speeds) for j in [*sorted(m[i]), i]]
    code += ["}", "inline void zero_fill(Real* b) {", "  const Real z = splat(0);"]
    code += [f"  b[{at(i, j)}] = z;" for i in range(tree.speeds) for j in sorted(filled[i] - m[i])]
    return [*code, "}"]


def constants(tree: Tree) -> list[str]:
    """Return the tree as constants."""

    def table(kind: str, name: str, values: list[int] | list[bool]) -> str:
        return f"constexpr {kind} {name}[] = {{{', '.join(str(int(value)) for value in values)}}};"

    bodies = range(len(tree.parents))
    return [
        "// Written by topology.py; included by humanoid_model.hpp within its namespace.",
        f"constexpr int kBodies = {len(tree.parents)}, kGeoms = {len(tree.geom_bodies)};",
        f"constexpr int kLeftFoot = {tree.feet[0]}, kRightFoot = {tree.feet[1]};",
        table("int", "kParent", tree.parents),
        table("int", "kAxis", tree.axes),
        table("int", "kGeomBody", tree.geom_bodies),
        table("int", "kGeomShape", tree.geom_shapes),
        '// Bodies of the arms, and of hips and waist: the pattern "arms" has their products.',
        table("bool", "kArm", [body in tree.arms for body in bodies]),
        table("bool", "kHip", [body in tree.hips for body in bodies]),
    ]


def main() -> None:
    """Write the files."""
    folder = Path(__file__).parent
    for robot in ("T1", "K1"):
        tree = tree_of(robot)
        for name, code in (("topology", constants(tree)), ("factor", matrices(tree))):
            (folder / f"{robot.lower()}_{name}.hpp").write_text("\n".join([*code, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
