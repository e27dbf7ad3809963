"""One file is an algorithm: whatever is made from rows knows it."""

import dataclasses
import importlib
import sys
from pathlib import Path

import jax
import pytest
from toys import START, Corridor

from jaxsafe import algos
from jaxsafe.config import ConfigError
from jaxsafe.interop import migrate
from jaxsafe.learn.on_policy import OnPolicyConfig
from jaxsafe.run.arguments import compose
from jaxsafe.run.settings import acts_by, find_algo, preset_for

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT / "docs"))
HALVED = '''
"""PPO-Halved: PPO whose advantage pays half a unit for each unit of cost."""

from functools import partial

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.row import Row
from jaxsafe.learn.treatments import penalty


@config
class HalvedConfig(ppo.PPOConfig):
    """PPO-Halved: PPO that pays half.

        A = A_r - A_c / 2
    """

    # The price of a unit of cost,
    # in standard deviations of A_r.
    price: float = 0.5


ROWS = {
    "ppo_halved": Row(
        HalvedConfig,
        partial(ppo.make, treatment=penalty),
        "PPO that pays half",
        {"omnisafe": {"price": 0.25}},
        omnisafe="PPOHalved",
        holds="nothing",
    )
}
'''


@pytest.mark.parametrize("name", [name for name, row in algos.ALGOS.items() if acts_by(row)])
def test_what_a_policy_acts_by_are_settings_that_change_nothing_it_learned(name):
    """Counts are doubled. Networks, the multiplier and the normaliser keep their shapes."""
    row = algos.ALGOS[name]
    names = acts_by(row)
    assert len({*names}) == len(names) and {*names} <= {f.name for f in dataclasses.fields(row.config)}
    cfg = row.config()
    counts = {x: 2 * n for x in names if type(n := getattr(cfg, x)) is int}
    algo = row.make(Corridor())

    def learned(cfg):
        return algo.learned(algo.init(jax.random.key(0), cfg, START))

    before, after = (jax.eval_shape(learned, x) for x in (cfg, dataclasses.replace(cfg, **counts)))
    for part in ("params", "dual", "normaliser"):
        assert getattr(before, part) == getattr(after, part)


@pytest.fixture
def halved(tmp_path, monkeypatch):
    """The name of an algorithm whose module lies in a folder that the registry lists."""
    (tmp_path / "halved.py").write_text(HALVED)
    monkeypatch.setattr(algos, "__path__", [*algos.__path__, str(tmp_path)])
    found = algos.listed()
    assert set(found) - set(algos.ALGOS) == {"ppo_halved"}
    monkeypatch.setitem(algos.ALGOS, "ppo_halved", found["ppo_halved"])
    yield "ppo_halved"
    sys.modules.pop("jaxsafe.algos.halved")
    del algos.halved  # type: ignore[attr-defined]


def test_a_file_with_a_row_is_known_to_whatever_is_made_from_rows(halved):
    texts = [f"algo={halved}", "preset=published", "compat=omnisafe", "algo.clip=0.1"]
    cfg = compose(texts).algo
    assert (cfg.price, cfg.clip, cfg.cost_window, cfg.num_envs) == (0.25, 0.1, 5, 512)

    from learners import on_policy_names

    assert halved in on_policy_names() and halved in on_policy_names(holds="nothing")
    pages, tables = importlib.import_module("pages"), importlib.import_module("tables")
    assert f"| on-policy | `PPOHalved` | ✓ [`{halved}`](" in tables.omnisafe_algorithms()
    assert f"`{halved}`" in tables.omnisafe_conventions()
    page = pages.page(halved)
    assert page.startswith("# PPO-Halved: PPO that pays half\n") and "A = A_r - A_c / 2" in page
    price = "The price of a unit of cost, in standard deviations of A_r."
    assert f"| `algo.price` | `0.5` |  | {price} |" in page and "[algos/halved.py]" in page
    assert f"[`{halved}`]({halved}.md)" in pages.algorithms()
    assert "PPO that pays half" in pages.algorithms()
    found = migrate.omnisafe({"algo": "PPOHalved", "env_id": "point_goal1"})
    assert f"algo={halved}" in found.argv


def test_two_rows_of_one_name_are_refused(tmp_path, monkeypatch):
    (tmp_path / "zzz.py").write_text("from jaxsafe.algos.ppo import ROWS")
    monkeypatch.setattr(algos, "__path__", [*algos.__path__, str(tmp_path)])
    with pytest.raises(ValueError, match=r"algos/zzz.py: another module has a row 'cppo_pid' already"):
        algos.listed()
    sys.modules.pop("jaxsafe.algos.zzz")


def test_a_row_of_your_own_is_loaded_by_its_address(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(algos, "ALGOS", {**algos.ALGOS})
    (tmp_path / "mine.py").write_text(f"{HALVED}\nrow, number = ROWS['ppo_halved'], 7\n")
    algos.load("mine:row")
    assert find_algo("mine:row").summary == "PPO that pays half"
    assert issubclass(find_algo("mine:row").config, OnPolicyConfig)
    assert (
        preset_for("walker2d_velocity", find_algo("mine:row")) == "fast"
    )  # it has no other that suits
    sys.modules.pop("mine")


@pytest.mark.parametrize(
    "address, message",
    [
        ("mine:", "algo=mine:: expected module:name"),
        ("mine_is_not_there:row", "no module 'mine_is_not_there'"),
        ("math:sinn", "math has no 'sinn'; did you mean 'sin'"),
        ("math:pi", "algo=math:pi: expected a jaxsafe.algos.Row, not float"),
    ],
)
def test_an_address_that_names_no_row_is_one_line(address, message, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    with pytest.raises(ConfigError, match=message) as error:
        algos.load(address)
    assert "\n" not in str(error.value) and address not in algos.ALGOS


@pytest.mark.parametrize(
    "name, message",
    [
        ("ppo_lagg", "unknown algo 'ppo_lagg'; did you mean 'ppo_lag'"),
        ("mine:row", "mine:row is code, which is not imported because a file names it"),
    ],
)
def test_a_name_that_is_not_registered_is_refused_and_never_imported(name, message):
    with pytest.raises(ConfigError, match=message):
        find_algo(name)


@pytest.mark.parametrize("name", sorted(algos.ALGOS))
def test_every_default_is_explained_in_a_sentence(name):
    for line in importlib.import_module("pages").settings(algos.ALGOS[name].config).splitlines()[2:]:
        note = line.rstrip(" |").rpartition(" | ")[2]
        assert note[:1].isupper() or note[:1].islower() or note[:1] == "_", line
        assert note.endswith(".") and " " in note, line


@pytest.mark.parametrize("name", sorted(algos.ALGOS))
def test_every_page_begins_with_a_title_an_equation_and_a_source(name):
    text = algos.ALGOS[name].config.__doc__ or ""
    title, equation = text.partition("\n\n")[::2]
    assert ": " in title or " in " in title
    assert equation.startswith("        ")  # indented, so that pages show it as code
    assert "Source: " in text or algos.ALGOS[name].holds == "nothing"
