"""Events within one solve: guards, resets and clocks around any Diffrax solver."""
