"""The report in a browser: no error, no overflow, zoom, words on nodes, layers, folding, keyboard, dark, no script.

Needs Debian's `chromium` and `chromium-driver` (`.ci/run` installs them); skipped where they are not.
"""

import shutil

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("bokeh")
pytest.importorskip("jinja2")
pytest.importorskip("selenium")

import committed
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from probcal.report import write_report

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(CHROMIUM is None or DRIVER is None, reason="no chromium and chromium-driver (Debian packages)"),
]
HOSTILE = '<img src=x onerror="window.broken=1">'
PLAN = "Bokeh.documents[0].get_model_by_name('map')"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Reports of the committed fits, and of one whose names are hostile: interactive and static."""
    folder, found = tmp_path_factory.mktemp("pages"), {}
    trees = {name: committed.tree(name) for name in committed.METHODS}
    trees["hostile"] = hostile(trees["ea"])
    for name, tree in trees.items():
        for static in (False, True):
            path = folder / f"{name}{'-static' * static}.html"
            found[path.stem] = write_report(tree, path, static=static).as_uri()
    return found


def hostile(tree):
    """The tree with names that are HTML, one of them long."""
    groups = {path: node.to_dataset(inherit=False) for path, node in tree.subtree_with_keys if path != "."}
    constant = groups["constant_data"]
    names = [f"{HOSTILE}{k}" for k in range(constant.sizes["node"])]
    groups["constant_data"] = constant.assign_coords(node=names)
    known = groups["calibration"]["bias_label"].values.tolist()
    labels = {label: f"{HOSTILE}.{'very_long_' * 12}{k}" for k, label in enumerate(known)}
    for name, group in groups.items():
        for coordinate in ("bias_label", "bias_label_other"):
            if coordinate in group.coords:
                renamed = [labels[label] for label in group[coordinate].values.tolist()]
                groups[name] = group = group.assign_coords({coordinate: renamed})
    for name in [n for n in groups if n.startswith("track/")]:
        groups[name].attrs["target"] = HOSTILE
    found = xr.DataTree.from_dict(groups)
    found.attrs.update(tree.attrs | {"message": HOSTILE, "model": HOSTILE, "data": HOSTILE})
    return found


@pytest.fixture(scope="module")
def browser():
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    found = webdriver.Chrome(options=options, service=Service(DRIVER))
    found.set_script_timeout(60)
    yield found
    found.quit()


def visit(browser, address, width=1280, dark=False, scripts=True):
    """Open a page and wait for its map; returns the errors that it wrote to the console."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": not scripts})
    browser.get_log("browser")
    browser.get(address)
    if scripts and "-static" not in address:
        browser.execute_async_script(
            "const done = arguments[0]; const look = () => !document.getElementById('controls').hidden &&"
            " Bokeh.documents.length && Bokeh.documents[0].is_idle ? done() : setTimeout(look, 50); look();"
        )
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


def unfold(browser):
    browser.execute_script("for (const one of document.querySelectorAll('details')) one.open = true")


def ranges(browser):
    return browser.execute_script(f"const r = {PLAN}; return [r.x_range.start, r.x_range.end]")


@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("kind", [*committed.METHODS, "hostile"])
def test_no_error_and_nothing_wider_than_the_page(browser, pages, kind, width):
    for name in (kind, f"{kind}-static"):
        assert visit(browser, pages[name], width) == []
        unfold(browser)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width, name
        assert browser.execute_script("return window.broken") is None
        assert browser.execute_script("return document.querySelectorAll('img[src=x]').length") == 0


def test_the_map_is_zoomed_by_keyboard_and_reset(browser, pages):
    visit(browser, pages["ea"])
    before = ranges(browser)
    button = browser.find_element(By.CSS_SELECTOR, "button[aria-label='Zoom in']")
    button.send_keys(Keys.ENTER)
    low, high = ranges(browser)
    assert high - low == pytest.approx(0.7 * (before[1] - before[0]))
    browser.find_element(By.CSS_SELECTOR, "button[aria-label='Show the whole map']").send_keys(Keys.SPACE)
    assert ranges(browser) == pytest.approx(before)


def wait(browser, condition):
    """Wait until a condition holds: Chromium scrolls and draws after the wheel's command has returned."""
    WebDriverWait(browser, 30, poll_frequency=0.05).until(lambda _: condition())


def test_the_wheel_zooms_with_ctrl_and_scrolls_without(browser, pages):
    visit(browser, pages["ea"])
    before, sheet = ranges(browser), ScrollOrigin.from_element(browser.find_element(By.ID, "map"))
    ActionChains(browser).scroll_from_origin(sheet, 0, 120).perform()
    wait(browser, lambda: browser.execute_script("return window.scrollY") > 0)
    assert ranges(browser) == pytest.approx(before)
    browser.execute_script("window.scrollTo(0, 0)")
    wait(browser, lambda: browser.execute_script("return window.scrollY") == 0)
    held = ActionChains(browser).key_down(Keys.CONTROL).scroll_from_origin(sheet, 0, -240).key_up(Keys.CONTROL)
    held.perform()
    wait(browser, lambda: np.ptp(ranges(browser)) < 0.95 * np.ptp(before))


def words_at(browser, source):
    """What the map says where the pointer is on the first entry of a source that has these columns."""
    browser.execute_script("document.getElementById('map').scrollIntoView({block: 'center'})")
    place = browser.execute_script(
        f"""const plan = {PLAN}, view = Bokeh.index.find_one(plan), box = view.canvas_view.el.getBoundingClientRect();
        const frame = view.frame, sources = plan.renderers.map((r) => r.data_source);
        const data = sources.find((source) => source.columns().includes(arguments[0]));
        const x = data.get_column("x")[0], y = data.get_column("y")[0];
        return [box.x + frame.x_scale.compute(x), box.y + frame.y_scale.compute(y)];""",
        source,
    )
    action = ActionChains(browser)
    action.w3c_actions.pointer_action.move_to_location(*(round(value) for value in place))
    action.perform()
    return browser.execute_async_script(
        """const done = arguments[0], began = Date.now(), look = () => {
          const found = [...document.querySelectorAll('*')].flatMap((e) => e.shadowRoot ? [e.shadowRoot] : []);
          const deep = (root) => [...root.querySelectorAll('*')].flatMap(
            (e) => [e, ...(e.shadowRoot ? deep(e.shadowRoot) : [])]);
          const tips = deep(document).filter((e) => e.classList?.contains('bk-tooltip-content'));
          const text = tips.map((e) => e.innerText).join('\\n');
          text || Date.now() - began > 30000 ? done(text) : setTimeout(look, 50); };
        look();"""
    )


def test_nodes_and_epochs_have_a_word(browser, pages):
    visit(browser, pages["ea"])
    assert "stated x" in words_at(browser, "words")
    visit(browser, pages["ea"])
    told = words_at(browser, "time")
    assert "time" in told
    assert "±" in told


def test_a_hostile_name_is_shown_as_it_stands(browser, pages):
    visit(browser, pages["hostile"])
    assert HOSTILE in words_at(browser, "words")
    assert browser.execute_script("return window.broken") is None


def test_layers_are_switched_by_keyboard(browser, pages):
    visit(browser, pages["ea"])
    seen = f"return {PLAN}.renderers.filter((r) => r.tags.includes('before')).map((r) => r.visible)"
    assert browser.execute_script(seen) == [True]
    browser.find_element(By.CSS_SELECTOR, "input[name='before']").send_keys(Keys.SPACE)
    assert browser.execute_script(seen) == [False]


def test_details_are_folded_and_open_by_keyboard(browser, pages):
    visit(browser, pages["ea"])
    details = browser.find_element(By.CSS_SELECTOR, "details.all")
    assert details.get_attribute("open") is None
    details.find_element(By.TAG_NAME, "summary").send_keys(Keys.ENTER)
    assert details.get_attribute("open") is not None
    assert details.find_element(By.TAG_NAME, "table").is_displayed()


def luminance(colour):
    """Relative luminance of a colour `rgb(r, g, b)` (WCAG 2.2)."""
    parts = np.array([float(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255
    return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]


@pytest.mark.parametrize("dark", [False, True])
def test_every_text_has_contrast(browser, pages, dark):
    visit(browser, pages["ea"], dark=dark)
    unfold(browser)
    pairs = browser.execute_script(
        """const ground = (e) => { for (; e; e = e.parentElement) { const c = getComputedStyle(e).backgroundColor;
             if (!c.endsWith(', 0)')) return c; } };
           return [...document.querySelectorAll('h1,h2,p,li,th,td,caption,summary,label,button,strong,span,footer')]
             .filter((e) => e.innerText).map((e) => [e.tagName, getComputedStyle(e).color, ground(e)]);"""
    )
    assert len(pairs) > 50
    for tag, ink, paper in pairs:
        low, high = sorted([luminance(ink), luminance(paper)])
        assert (high + 0.05) / (low + 0.05) >= 4.5, (tag, ink, paper)
    axis = browser.execute_script(
        f"return {PLAN}.below[0].major_label_text_color + ' ' + getComputedStyle(document.body).color"
    )
    assert axis.split(" ")[0] == ("#e8e8e8" if dark else "#1a1a1a")


def test_without_scripts_a_picture_stands_for_the_map(browser, pages):
    try:
        visit(browser, pages["ea"], scripts=False)
        picture = browser.find_element(By.CSS_SELECTOR, "noscript img")
        assert picture.is_displayed()
        assert picture.size["width"] > 300
        assert not browser.find_element(By.ID, "controls").is_displayed()
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
