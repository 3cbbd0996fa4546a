"""Types and shapes of what benchmarks are built on are checked as the package's are."""

from jaxtyping import install_import_hook

install_import_hook(
    ["modes", "tracks"], "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
)
