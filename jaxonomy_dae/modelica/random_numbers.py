"""The generators of random numbers that Modelica's library has in C: xorshift64*, xorshift128+ and xorshift1024*.

A state is a list of 32-bit integers, two for each word, its lower half first; that of xorshift1024* ends with the place
of the word that is next. Each generator takes a state and returns (a number in (0, 1], the next state). They are those
of Vigna (2016), except that xorshift64* goes on from the product, and xorshift128+ from the sum, that it returns.

States that are known while a model is read are integers of Python, others are arrays: a generator works on words, which
`_Integers` or `_Arrays` make from a state.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
import sympy

from ..base.aliases import Numeric
from ..base.errors import ModelError
from ..write.component import Component
from ..write.symbols import DiscreteSymbol, VariableSymbol
from .values import Results, Value

Word: TypeAlias = Numeric  # an int below 2^64, or an array of the type uint64
BITS = (1 << 64) - 1
ROUNDS = 10  # that hide a poor seed
NO_SEED = 126247697  # in place of two seeds that are zero, of which xorshift makes zeros for ever


def _xorshift64star(words: list[Word], place: Word, cut: Callable[[Word], Word]) -> tuple[Word, list[Word], Word]:
    (x,) = words
    x = x ^ x >> 12
    x = x ^ cut(x << 25)
    x = cut((x ^ x >> 27) * _like(x, 2685821657736338717))
    return x, [x], place


def _xorshift128plus(words: list[Word], place: Word, cut: Callable[[Word], Word]) -> tuple[Word, list[Word], Word]:
    a, b = words
    a = a ^ cut(a << 23)
    new = cut((a ^ b ^ a >> 17 ^ b >> 26) + b)
    return new, [b, new], place


def _xorshift1024star(words: list[Word], place: Word, cut: Callable[[Word], Word]) -> tuple[Word, list[Word], Word]:
    after = (place + 1) % len(words)
    a, b = _at(words, place % len(words)), _at(words, after)
    b = b ^ cut(b << 31)
    new = a ^ a >> 30 ^ b ^ b >> 11
    return cut(new * _like(new, 1181783497276652981)), _with(words, after, new), after


def _like(word: Word, number: int) -> Word:
    return number if isinstance(word, int) else np.uint64(number)


def _at(words: list[Word], place: Word) -> Word:
    return words[int(place)] if isinstance(place, int) else jnp.stack(words)[place]


def _with(words: list[Word], place: Word, new: Word) -> list[Word]:
    return [new if k == place else w for k, w in enumerate(words)] if isinstance(place, int) else [
        jnp.where(place == k, new, w) for k, w in enumerate(words)
    ]  # fmt: skip


GENERATORS = {
    "xorshift64star": (_xorshift64star, 2),
    "xorshift128plus": (_xorshift128plus, 4),
    "xorshift1024star": (_xorshift1024star, 33),
}


def number(name: str, state: Sequence[int]) -> Results:
    """(A random number, the next state), from a state of integers."""
    step, count = GENERATORS[name]
    half = (1 << 32) - 1
    words = [(low & half) | (high & half) << 32 for low, high in zip(state[0:32:2], state[1:32:2], strict=True)]
    word, words, place = step(words, int(state[-1]) if count % 2 else 0, lambda w: w & BITS)
    halves = [_signed(h, 32) for w in words for h in (w & half, w >> 32)]
    return Results([_signed(word, 64) / 2.0**64 + 0.5, halves + [place] * (count % 2)])


def _signed(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value


def numbers(name: str) -> Callable[..., Numeric]:
    """A function in JAX from the entries of a state, as floating-point numbers, to the random number and the entries of
    the next state."""
    step, count = GENERATORS[name]

    def function(*state: Numeric) -> Numeric:
        if jnp.result_type(float) != jnp.float64:
            raise ModelError(
                f"the random generator {name} computes with integers of 64 bits: "
                'jax.config.update("jax_enable_x64", True)'
            )
        whole = [jnp.asarray(s).astype(jnp.int64) for s in state]
        # A half may be negative. Cut to 32 bits it keeps its own bits, and does not fill those of the other half with
        # ones.
        unsigned = [w.astype(jnp.uint32).astype(jnp.uint64) for w in whole]
        words = [low | high << 32 for low, high in zip(unsigned[0:32:2], unsigned[1:32:2], strict=True)]
        word, words, place = step(words, whole[-1], lambda w: w)
        halves = [h.astype(jnp.uint32).astype(jnp.int32) for w in words for h in (w, w >> 32)]
        found = [word.astype(jnp.int64).astype(float) / 2.0**64 + 0.5, *halves, *([place] if count % 2 else [])]
        return jnp.stack([jnp.asarray(f).astype(float) for f in found])

    return function


def initial_state(local_seed: int, global_seed: int) -> list[int]:
    """A state of xorshift64* from two seeds."""
    state = [int(local_seed), int(global_seed)] if local_seed or global_seed else [NO_SEED, 0]
    for _ in range(ROUNDS):
        state = number("xorshift64star", state)[1]
    return state


class RandomNumbers:
    """The generators as functions of a flat model. Where a state is kept from event to event, what follows it is a
    variable of the component, in hidden equations, so that an event finds it for the state before.

    - `starting`: True while initial equations are read: the state is then what it starts at.
    """

    def __init__(self, component: Component):
        self.component = component
        self.known: dict[tuple, tuple] = {}
        self.starting = False

    def functions(self) -> dict[str, Callable[[list], Results]]:
        """The functions by their names in C; the first one also by its name in Modelica, since texts leave its
        definition out."""
        found = {name: lambda state, name=name: self.after(name, state) for name in GENERATORS}
        library = {"Modelica.Math.Random.Generators.Xorshift64star.random": found["xorshift64star"]}
        return {f"ModelicaRandom_{name}": function for name, function in found.items()} | library

    def after(self, name: str, state: list[Value]) -> Results:
        """(A random number, the next state)."""
        if self.starting:
            state = [self.component.parameters[s.path].value if isinstance(s, DiscreteSymbol) else s for s in state]
        if all(isinstance(s, int | float) for s in state):
            return number(name, [int(s) for s in state])
        key = (name, *state)
        if key not in self.known:
            self.known[key] = self.component.function(
                f":random[{len(self.known)}]", numbers(name), [self._as_variable(s) for s in state]
            )
        r, *after = self.known[key]
        return Results([r, after])

    def _as_variable(self, entry: Value) -> VariableSymbol:
        if not isinstance(entry, int | float | DiscreteSymbol):
            raise ModelError(f"the state of a random generator is kept in variables that a when assigns; got {entry}")
        symbol = self.component.variable(f":state[{len(self.component.variables)}]")
        self.component.add_equations(sympy.Eq(symbol, entry, evaluate=False))
        return symbol
