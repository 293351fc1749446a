"""gonio: a self-hosted gait laboratory."""

from gonio.compiled_cache import keep_compiled_code_apart

keep_compiled_code_apart()
