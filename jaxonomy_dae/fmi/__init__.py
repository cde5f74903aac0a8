"""Models for other tools: functions of JAX written in C."""
