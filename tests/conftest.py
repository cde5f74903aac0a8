"""Settings every test relies on. They must be made before `jaxonomy_dae` is first imported."""

import os

import hypothesis
import jax
import jaxtyping

os.environ["MPLBACKEND"] = "Agg"

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Shapes and types in signatures are checked here, and only here: users pay nothing for them.
jaxtyping.install_import_hook("jaxonomy_dae", "beartype.beartype")

# The same examples in every run, and no deadline: the first call of a jitted function compiles it.
hypothesis.settings.register_profile("deterministic", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("deterministic")
