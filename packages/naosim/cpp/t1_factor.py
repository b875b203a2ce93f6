"""Write ``t1_factor.hpp`` beside this file: factorisation, solve and product of a T1's sparse matrices.

Developers run it after a change of the tree: ``python packages/naosim/cpp/t1_factor.py``. Rows are eliminated from 28
to 0 in every pattern, and sums are split by the parity of the index: an entry that is zero in a sparser pattern changes
no bit.
"""

from __future__ import annotations

from pathlib import Path

PARENTS = (-1, 0, 1, 0, 3, 4, 5, 0, 7, 8, 9, 0, 11, 12, 13, 14, 15, 16, 11, 18, 19, 20, 21, 22)
SPEEDS = 29
ARMS, WAIST_AND_HIPS = range(8, 16), (16, 17, 18, 23, 24)

Pattern = list[set[int]]
"""Columns below the diagonal, row by row."""


def tree() -> Pattern:
    """Return the sparsity of the inertia matrix: a joint, its ancestors and the free joint."""
    rows: Pattern = []
    for i in range(SPEEDS):
        row, body = set(range(min(i, 6))), PARENTS[i - 5] if i >= 6 else 0
        while body > 0:
            row.add(body + 5)
            body = PARENTS[body]
        rows.append(row)
    return rows


def arms() -> Pattern:
    """Return the sparsity with contacts of hands and thighs, and the fill of its elimination."""
    rows = tree()
    for i in WAIST_AND_HIPS:
        rows[i] |= set(ARMS)
    for k in reversed(range(SPEEDS)):
        for i in rows[k]:
            rows[i] |= {j for j in rows[k] if j < i}
    return rows


def at(i: int, j: int) -> int:
    """Return the index of an entry of the packed lower triangle."""
    return i * (i + 1) // 2 + j


def below(rows: Pattern, i: int) -> list[int]:
    """Return the rows with an entry in column i, last first."""
    return [k for k in reversed(range(SPEEDS)) if i in rows[k]]


def subtract(i: int, terms: list[tuple[int, int]]) -> str:
    """Return the code of ``x[i] -= sum of H[entry] x[k]``."""
    even = "".join(f" s -= H[{entry}] * x[{k}];" for entry, k in terms if k % 2 == 0)
    odd = "".join(f" t += H[{entry}] * x[{k}];" for entry, k in terms if k % 2)
    return f"  {{ Real s = x[{i}], t = splat(0);{even}{odd} x[{i}] = s - t; }}"


def factor(name: str, rows: Pattern) -> list[str]:
    """Return the code of H = L^T D L in place and of 1 / D."""
    code = [f"inline void factor_{name}(Real* __restrict H, Real* __restrict inv) {{", f"  Real D[{SPEEDS}];"]
    for i in reversed(range(SPEEDS)):
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
    code = [f"inline void solve_{name}(const Real* __restrict H, const Real* __restrict inv, Real* __restrict x) {{"]
    code += [subtract(i, [(at(k, i), k) for k in below(rows, i)]) for i in reversed(range(SPEEDS)) if below(rows, i)]
    code.append(f"  for (int i = 0; i < {SPEEDS}; ++i) x[i] *= inv[i];")
    code += [subtract(i, [(at(i, k), k) for k in sorted(rows[i])]) for i in range(SPEEDS) if rows[i]]
    return [*code, "}"]


def multiply(rows: Pattern) -> list[str]:
    """Return the code of y = M x."""
    code = ["inline void mul_tree(const Real* __restrict M, const Real* __restrict x, Real* __restrict y) {"]
    for i in range(SPEEDS):
        terms = [(at(i, j), j) for j in [*sorted(rows[i]), i]] + [(at(k, i), k) for k in reversed(below(rows, i))]
        half = len(terms) // 2
        sums = " + ".join(
            f"({' + '.join(f'M[{a}] * x[{b}]' for a, b in part)})" for part in (terms[:half], terms[half:]) if part
        )
        code.append(f"  y[{i}] = {sums};")
    return [*code, "}"]


def main() -> None:
    """Write the file."""
    m, filled = tree(), arms()
    code = ["// Written by t1_factor.py; included by t1_dynamics.hpp within its namespace."]
    for name, rows in (("tree", m), ("arms", filled)):
        code += [*factor(name, rows), *solve(name, rows)]
    code += [*multiply(m), "inline void copy_tree_fast(const Real* __restrict a, Real* __restrict b) {"]
    code += [f"  b[{at(i, j)}] = a[{at(i, j)}];" for i in range(SPEEDS) for j in [*sorted(m[i]), i]]
    code += ["}", "inline void zero_fill(Real* b) {", "  const Real z = splat(0);"]
    code += [f"  b[{at(i, j)}] = z;" for i in range(SPEEDS) for j in sorted(filled[i] - m[i])]
    Path(__file__).with_suffix(".hpp").write_text("\n".join([*code, "}", ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
