"""The flat model: templates, tables, quantities."""
