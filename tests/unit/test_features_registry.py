"""Components by name."""

from __future__ import annotations

import subprocess
import sys

import pytest

from georef.errors import ConfigError
from georef.features.registry import EXTRACTORS, MATCHERS, ComponentTable, load_component


def test_a_component_is_made_with_its_options() -> None:
    assert "contrast=0.04" in load_component(EXTRACTORS, "sift", contrast_threshold=0.04).version()


def test_an_unknown_name_lists_the_known_and_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"aliked-n16, .*sift.*\nDid you mean 'sift'\?"):
        load_component(EXTRACTORS, "SIFT2")


def test_an_unknown_option_lists_the_known() -> None:
    with pytest.raises(ConfigError, match="Expected options: ratio, min_similarity, chunk"):
        load_component(MATCHERS, "mutual-nn", ratios=0.8)


def test_a_component_that_cannot_be_imported_is_a_configuration_error() -> None:
    table = ComponentTable("extractor", "georef.none", {"gone": "georef.features.absent:Gone", "odd": "json:Absent"})
    for name in table:
        with pytest.raises(ConfigError, match="cannot be loaded"):
            load_component(table, name)


def test_torch_is_imported_only_when_needed() -> None:
    code = (
        "import sys; from georef.features.registry import EXTRACTORS, MATCHERS, load_component;"
        "load_component(EXTRACTORS, 'sift'); load_component(MATCHERS, 'mutual-nn'); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
