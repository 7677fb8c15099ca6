"""The report as a web page: what it holds, that it asks nobody for anything, and its sliders in a browser."""

import base64
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
import torch
from chromium import CHROMIUM, browser, needs_chromium, touch
from PIL import Image

from sundae_ns.core.errors import DataError
from sundae_ns.report.measure import cells_of
from sundae_ns.report.report_page import (
    ERROR_COLORS,
    EXACT_SIDE,
    LARGEST_ERROR,
    LONGEST_SIDE,
    MOST_VIEWS,
    ShownRun,
    choose_cameras,
    error_map,
    report_page,
    shown_view,
)
from sundae_ns.train.curve import CountCurve, CurvePoint

HOSTILE = """"'></h4><script>window.harmed = 1</script><img src=x onerror='window.harmed = 1'>{{ 7*7 }}&amp;"""
LOSSES = {9000: 0.0, 3000: 0.1, 1000: 1.0}
POINTS = (CurvePoint(n, None, 26 - loss, 0.9 - loss / 20, loss, loss / 20, 0.05, 0.001) for n, loss in LOSSES.items())
CURVE = CountCurve(3000, 9000, f"the smallest within 0.1 dB {HOSTILE}", tuple(POINTS))


class Page(HTMLParser):
    """The elements of a page, with their attributes and text; refuses elements that are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.text = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs), "an attribute stands twice"
        self.elements.append((tag, dict(attrs)))
        if tag not in {"meta", "img", "input", "br", "link"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())

    def all(self, tag):
        return (attributes for name, attributes in self.elements if name == tag)


def decoded(address):
    found = re.fullmatch(r"data:image/(png|webp);base64,([\w+/=]+)", address or "")
    assert found
    image = Image.open(BytesIO(base64.b64decode(found[2], validate=True)))
    assert image.format == found[1].upper()
    image.load()
    return image


def images(seed=0, height=24, width=32):
    """A photo, its rendering, and that without the head."""
    return torch.rand(3, height, width, 3, generator=torch.Generator().manual_seed(seed))


def shown(run, *, name="", **options):
    views = []
    for i, view in enumerate(run.full.views):
        base = run.base.views[i] if run.has_head else None
        views.append(shown_view(i, f"{i}{name}", *layers(*images(i), head=base is not None), view, base))
    return ShownRun(run, views, **options)


def layers(photo, rendering, bare, *, head):
    """A photo, and the images over it."""
    return photo, {"rendering": rendering, **({"head off": bare} if head else {})}


def page_of(*runs, notes=()):
    return report_page(runs, notes, "sundae compare x")


@pytest.fixture
def text(measured):
    """A page of a run with a head and a curve, and of one without."""
    return page_of(shown(measured(), curve=CURVE), shown(measured("b", head=False)))


def test_the_worst_and_the_best_view_are_among_those_that_are_shown():
    random = np.random.default_rng(0)
    for count in (1, 2, 5, 23, 24, 25, 300, 1000):
        for most in (2, 3, 7, MOST_VIEWS):
            qualities = random.uniform(10, 40, count).tolist()
            chosen = choose_cameras(qualities, most)
            assert len(chosen) == min(most, count)
            assert chosen == sorted(set(chosen))
            assert {int(np.argmin(qualities)), int(np.argmax(qualities))} <= set(chosen)
    qualities = [float(7 * i % 300) for i in range(300)]  # others are evenly spaced between them
    assert set(np.diff(sorted(qualities[i] for i in choose_cameras(qualities, 24)))) == {13.0}
    qualities[31] = math.nan  # counts as worst
    assert choose_cameras(qualities, 2) == [31, qualities.index(299.0)]


def test_errors_have_their_place_among_the_colors():
    photo = torch.zeros(1, 4, 3)
    levels = torch.tensor([0.0, LARGEST_ERROR / 2, LARGEST_ERROR, 255]) / 255
    found = error_map(levels[None, :, None].expand(1, 4, 3), photo)
    assert found.size == (4, 1)
    first, half, *most = np.asarray(found.convert("RGB"))[0].tolist()
    colors, middle = ERROR_COLORS.tolist(), len(ERROR_COLORS) // 2
    assert first == colors[0]
    assert half in colors[middle - 1 : middle + 1]
    assert most == [colors[-1]] * 2
    # The mean of the channels, whatever the sign.
    one = torch.tensor([LARGEST_ERROR / 255, 0.0, 0.0]).expand(1, 4, 3)
    three = torch.full((1, 4, 3), LARGEST_ERROR / 255 / 3)
    assert np.array_equal(error_map(one, photo), error_map(photo, three))


def test_a_smaller_error_map_has_the_mean_of_its_pixels_and_both_images_have_one_size():
    photo, rendering = torch.zeros(2, 8, 16, 3)
    rendering[:, ::2] = LARGEST_ERROR / 255
    half = torch.full((4, 8, 3), LARGEST_ERROR / 255 / 2)
    assert np.array_equal(error_map(rendering, photo, (8, 4)), error_map(half, torch.zeros(4, 8, 3)))
    for shape in ((8, 9, 3), (8, 8, 1), (8, 8)):
        with pytest.raises(DataError, match="give two of one size"):
            error_map(torch.zeros(shape), torch.zeros(8, 8, shape[-1]))


@pytest.mark.parametrize("head", [True, False])
@pytest.mark.parametrize(
    ("size", "expected"),
    [((24, 32), (32, 24)), ((700, 2400), (LONGEST_SIDE, 350)), ((24, EXACT_SIDE), (EXACT_SIDE, 24))],
)
def test_images_of_a_view_have_one_size_and_small_ones_lose_nothing(measured, size, expected, head):
    run, (photo, rendering, bare) = measured(), images(0, *size)
    given = layers(photo, rendering, bare, head=head)
    view = shown_view(3, "a.png", *given, run.full.views[0], run.base.views[0] if head else None)
    assert (view.index, view.name, view.size, view.shown_size) == (3, "a.png", size[::-1], expected)
    assert list(view.images) == ["rendering", *(["head off"] if head else []), "error map"]
    given = {"photo": photo, "rendering": rendering, "head off": bare}
    for name, address in {"photo": view.truth, **view.images}.items():
        found = decoded(address)
        assert found.size == expected
        if name in given:
            exact = found.size == size[::-1] and np.array_equal(found, (255 * given[name]).round().numpy())
            assert exact == (expected[0] <= EXACT_SIDE)
        elif found.size == size[::-1]:
            assert np.array_equal(found.convert("RGB"), error_map(rendering, photo).convert("RGB"))


def test_a_rendering_that_is_not_finite_is_shown(measured):
    broken = torch.full((16, 16, 3), math.nan)
    view = shown_view(0, "a", torch.ones(16, 16, 3), {"rendering": broken}, measured().full.views[0], None)
    assert np.asarray(decoded(view.images["rendering"])).max() == 0
    errors = np.asarray(decoded(view.images["error map"]).convert("RGB"))
    assert np.array_equal(np.unique(errors), np.unique(ERROR_COLORS[-1]))


def outside(text):
    """Addresses in a page that are not in it."""
    plain = re.sub(r"data:[\w/+]+;base64,[\w+/=]+", "", text)
    named = r"\b(?:https?|ftp|file|wss?):|@import|url\((?!#)|<(?:link|iframe|object|base)\b"
    named += r"""|(?:src|href|action|srcset)=["'](?!["'#])[^"']+"""
    return re.findall(named, plain, re.IGNORECASE)


def test_it_asks_nobody_for_anything(text):
    assert outside(text) == []
    for wrong in ('<img src="a.png">', "fetch('https://a')", "url(a.png)", "<link>"):
        assert outside(wrong)
    (policy,) = [value["content"] for value in Page(text).all("meta") if value.get("http-equiv")]
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert (rules["default-src"], rules["img-src"]) == ("'none'", "data:")
    assert re.fullmatch(r"'sha256-[\w+/=]+'", rules["script-src"])


def test_every_image_decodes_and_names_of_elements_are_unique(text):
    page = Page(text)
    drawn = [image for image in page.all("img") if "width" in image]
    # Photo, rendering, rendering without the head and error map; photo, rendering and error map.
    assert len(drawn) == 3 * 4 + 3 * 3
    for image in drawn:
        assert decoded(image["src"]).size == (32, 24) == (int(image["width"]), int(image["height"]))
        assert (image["loading"], image["decoding"]) == ("lazy", "async")
    assert all(image["alt"] for image in page.all("img"))
    names = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(names) == len(set(names))
    wanted = {attributes.get(key) for _, attributes in page.elements for key in ("for", "aria-labelledby")}
    assert wanted - {None} <= set(names)


def test_its_figures_are_those_of_the_report(measured):
    run = measured()
    page = Page(page_of(shown(run)))
    for row in cells_of([run])[1]:
        assert " ".join(row) in page.words
    for view, base in zip(run.full.views, run.base.views, strict=True):
        figures = f"PSNR {view.psnr:.2f} dB, SSIM {view.ssim:.4f}, colours fitted 26.00 dB"
        assert f"{figures} head off: PSNR {base.psnr:.2f}" in page.words
    assert [float(card["data-psnr"]) for card in page.all("article")] == [view.psnr for view in run.full.views]
    assert "sundae compare x" in page.words
    assert "All 3 views" in page.words
    assert "2 of 3 views" in Page(page_of(replace(shown(run), views=shown(run).views[:2]))).words


def test_hostile_names_stay_text(measured):
    run = replace(measured(HOSTILE, scene=HOSTILE), source=HOSTILE, method=HOSTILE, variant=HOSTILE)
    hostile = Page(page_of(shown(run, name=HOSTILE, curve=CURVE), notes=(HOSTILE,)))
    plain = Page(page_of(shown(measured(), name="b", curve=CURVE), notes=("a note",)))
    assert [name for name, _ in hostile.elements] == [name for name, _ in plain.elements]
    assert [list(found) for _, found in hostile.elements] == [list(found) for _, found in plain.elements]
    assert sum(name == "script" for name, _ in hostile.elements) == 1
    assert hostile.words.count(" ".join(HOSTILE.split())) > 10
    assert any(f"0{HOSTILE}" == card["data-name"] for card in hostile.all("article"))


def test_the_curve_marks_the_choice(text, measured):
    page = Page(text)
    assert "Chosen: 3,000 of 9,000 Gaussians" in page.words
    plots = [plot["aria-label"] for plot in page.all("svg")]
    assert [label.partition(";")[2] for label in plots] == [" 3,000 of 9,000 were chosen"] * 2
    assert text.count("<circle") == 2 * len(CURVE.points)
    assert page_of(shown(measured())).count("<svg") == 0


def test_views_of_other_runs_stand_beside_those_of_the_same_capture(measured):
    runs = [shown(measured(name), capture=capture) for name, capture in (("a", "x"), ("b", "x"), ("c", "y"))]
    page = Page(page_of(*runs, shown(measured("d", scene="other"), capture="x")))
    choices = [choice["value"] for choice in page.all("option") if (choice.get("value") or "").startswith("v")]
    places = [card["id"] for card in page.all("article") if card["id"].startswith(("v0", "v1"))]
    assert choices == [*places[3:], *places[:3]] == ["v1-0", "v1-1", "v1-2", "v0-0", "v0-1", "v0-2"]


def in_browser(test):
    return pytest.mark.browser(needs_chromium(test))


@pytest.fixture
def opened(measured, tmp_path):
    runs = [shown(measured("a"), curve=CURVE, capture="x", name=HOSTILE), shown(measured(HOSTILE, head=False))]
    runs.append(shown(measured("c"), capture="x", name=HOSTILE))
    (tmp_path / "report.html").write_text(page_of(*runs), encoding="utf-8")
    with browser.Browser(CHROMIUM, 400, 700) as page:
        page.open((tmp_path / "report.html").as_uri())
        ready = "document.documentElement?.classList.contains('ready') ?? false"
        browser.wait_for(lambda: page.evaluate(ready), "the page", 60)
        yield page
        assert page.evaluate("typeof window.harmed") == "undefined"
        assert page.errors == []


def of_first(page, body):
    """A value that a script finds in the first view of the page."""
    return page.evaluate(f"(() => {{ const card = document.querySelector('.view'); return {body}; }})()")


def place(page):
    """Left, top, width and height of the first view's image in the window, in pixels."""
    found = "[r.x, r.y, r.width, r.height]"
    stage = "card.querySelector('.stage')"
    x, y, width, height = of_first(page, f"({stage}.scrollIntoView(), (r => {found})({stage}.getBoundingClientRect()))")
    return x, y, width, height


CLIP = "getComputedStyle(card.querySelector('.over:not([hidden])')).clipPath"


@in_browser
def test_keys_and_pointer_move_the_slider(opened):
    assert of_first(opened, CLIP) == "inset(0px 0px 0px 50%)"
    of_first(opened, "card.querySelector('input[type=range]').focus()")
    for _ in range(3):
        opened.key("ArrowRight", 39)
    assert of_first(opened, CLIP) == "inset(0px 0px 0px 53%)"
    text = of_first(opened, "card.querySelector('input[type=range]').getAttribute('aria-valuetext')")
    assert text == "53% photo, the rest rendering"
    x, y, width, height = place(opened)
    opened.drag(x + width / 2, y + height / 2, x + width / 4, y + height / 2)
    value = int(of_first(opened, "card.querySelector('input[type=range]').value"))
    assert abs(value - 25) <= 1
    assert of_first(opened, CLIP) == f"inset(0px 0px 0px {value}%)"
    assert opened.evaluate("document.activeElement.type") == "range"
    # Wider than the window, nothing is: a phone would scroll sideways.
    assert opened.evaluate("document.documentElement.scrollWidth") == 400


@in_browser
def test_a_finger_moves_the_slider_or_scrolls_the_page(opened):
    x, y, width, height = place(opened)
    value, scrolled = "card.querySelector('input[type=range]').value", "window.scrollY"
    middle = round(y + height / 2)
    touch(opened, (round(x + width / 2), middle), (round(x + width * 0.8), middle))
    browser.wait_for(lambda: of_first(opened, value) == "80", "the slider", 30)
    before = opened.evaluate(scrolled)
    touch(opened, (round(x + width / 2), middle + 100), (round(x + width / 2), middle - 200))
    browser.wait_for(lambda: opened.evaluate(scrolled) > before, "the page to scroll", 30)
    assert of_first(opened, value) == "80"


@in_browser
def test_layers_order_and_the_other_run(opened):
    drawn = "[...card.querySelectorAll('.over:not([hidden])')].map(e => e.dataset.layer).join()"
    assert of_first(opened, drawn) == "rendering"
    of_first(opened, "card.querySelector('input[value=\"error map\"]').click()")
    assert of_first(opened, drawn) == "error map"
    assert of_first(opened, "card.querySelector('.tag.right').textContent") == "error map"
    choose = "(select => (select.value = %s, select.dispatchEvent(new Event('change'))))(document.querySelector('.%s'))"
    opened.evaluate(choose % ("'head off'", "all"))
    assert of_first(opened, drawn) == "head off"

    order = "[...document.querySelector('.views').children].map(e => Number(e.dataset.psnr))"
    assert opened.evaluate(order) == sorted(opened.evaluate(order))
    opened.evaluate(choose % ("'best'", "order"))
    assert opened.evaluate(order) == sorted(opened.evaluate(order), reverse=True)
    opened.evaluate(choose % ("'capture'", "order"))
    assert opened.evaluate("[...document.querySelector('.views').children].map(e => e.dataset.index).join()") == "0,1,2"

    source = "card.querySelector('.under').src"
    photo = of_first(opened, source)
    opened.evaluate(choose % ("document.querySelector('.beside').options[1].value", "beside"))
    assert of_first(opened, source) == opened.evaluate("document.querySelector('#v2-0 [data-layer=rendering]').src")
    assert of_first(opened, "card.querySelector('.tag.left').textContent") == "c"
    opened.evaluate(choose % ("''", "beside"))
    assert of_first(opened, source) == photo
