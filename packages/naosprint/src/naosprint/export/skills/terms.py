"""Compute what a policy observes, from its description as data in policy.npz, and its actions; needs only NumPy."""

import json

import numpy as np

ACTIVATIONS = {"tanh": np.tanh, "relu": lambda values: np.maximum(values, 0), "linear": lambda values: values}


class Observations:
    """Interpreter of a description: what is observed, and what is stored for it between cycles."""

    def __init__(self, text, width):
        self.__dict__.update(json.loads(str(text)))
        self.width = width  # of an observation with its earlier steps
        self.begin()

    def begin(self, arrays=None):
        """Begin a run; with `arrays`, by name, in the middle of another policy's.

        What is stored with one of them, such as `velocity` with `velocity_position`, continues; the rest begins. It
        begins with the first observation whose numbers are all finite.
        """
        self.arrays, known = [np.zeros(width) for _, width in self.stored], arrays or {}
        self.continuing = set()
        for place, (name, _) in enumerate(self.stored):
            if name in known:
                self.arrays[place] = np.array(known[name], float)
            if any(f"{given}_".startswith(f"{name}_") for given in known):
                self.continuing.add(place)
        self.first, self.before, self.past = True, None, []

    def has(self, name):
        """Return whether an input is observed."""
        return any(label == [name] for _, _, _, *label in self.nodes)

    def get(self, name):
        """Return what is stored by this name."""
        return self.arrays[[each for each, _ in self.stored].index(name)]

    def observe(self, inputs):
        """Return the observation, once per cycle. Raises KeyError for an input that is missing.

        Of numbers that are not finite the next cycles remember the latest finite ones.
        """
        self.inputs = inputs
        for target, begin, update in self.stores:
            place = begin if self.first and target not in self.continuing else update
            if place is not None:
                self.arrays[target] = latest(self.value(place, {}), self.arrays[target])
        known, now, before = {}, [], iter(self.before or [])
        values = [self.value(place, known) for place, _, _ in self.blocks]
        for value, (_, rates, angular) in zip(values, self.blocks):
            now.append(value)
            rate = value - next(before, value) if rates else np.zeros(0)
            now.append((rate + np.pi) % (2 * np.pi) - np.pi if angular else rate)
        seen = np.concatenate(now)
        steps = self.width // len(seen)
        past = self.past or [seen] * steps  # before a run everything was as it is at its start
        if not self.first or np.isfinite(seen).all():
            rated = [value for value, (_, rates, _) in zip(values, self.blocks) if rates]
            self.before = [latest(*pair) for pair in zip(rated, self.before or rated)]
            self.first, self.past = False, [latest(seen, past[0]), *past][:steps]
        return np.concatenate([seen, *past][:steps])

    def value(self, place, known):
        """Return the numbers of a node; `known` has those that are computed already."""
        if place not in known:
            function, arguments, constants, *label = self.nodes[place]
            known[place] = self.compute(function, [self.value(each, known) for each in arguments], constants, label)
        return known[place]

    def compute(self, function, values, constants, label):
        """Return a function's numbers; it has the name of NumPy's, unless it is listed here."""
        if function == "input":
            value = np.ravel(np.asarray(self.inputs[label[0]], float))
            return value[constants] if constants else value
        if function == "stored":
            return self.arrays[constants[0]][constants[1:]]
        if function == "constant":
            return np.array(constants, float)
        if function == "columns":
            return values[0][np.array(constants, int)]
        if function == "stack":
            return np.concatenate(values)
        if function == "sum":
            return values[0].sum(keepdims=True)
        if function == "product":
            return (values[0].reshape(3, 3) @ values[1].reshape(3, -1)).ravel()
        if function == "interpolated":
            return np.interp(values[0], *np.split(np.array(constants), 2))
        if function == "where":
            return np.where(values[0] != 0, *values[1:])
        return np.asarray(getattr(np, function)(*values), float)


def latest(values, before):
    """Return values, and those before them where they are not finite."""
    return np.where(np.isfinite(values), values, before)


def computed(network, observation, before):
    """Return the actions of a network in [-1, 1]; those before if a number of the observation is not finite."""
    if not np.isfinite(observation).all():
        return before
    values = np.clip((observation - network.mean) * network.scale, -network.clip, network.clip)
    for i in range(network.layers):
        values = getattr(network, f"weights_{i}") @ values + getattr(network, f"bias_{i}")
        values = ACTIVATIONS[str(network.activations[i])](values)
    return np.clip(values, -1, 1)
