"""What comes from data folders and cells reaches the report as text, or is refused."""

import html
import re
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.notebook import code, inline, plain, plotting
from slamlib.report import NotebookError, build_report
from slamlib.report.options import Cover, Options
from slamlib.report.pages import html_page
from slamlib.report.pdf import typst_files
from slamlib.report.sanitize import cleaned, sanitized
from slamlib.simulation import simulate, write_dataset

RUN = "document.title='ran'"
LINK = f"javascript:void({RUN})"
POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">')
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">{}</svg>'
RUNNING = {  # by themselves, or when their link or button is clicked
    "script": f"<script>{RUN}</script>",
    "onerror": f'<img src="data:image/png;base64,AA" onerror="{RUN}">',
    "onload": f'<svg onload="{RUN}"></svg>',
    "script in SVG": SVG.format(f"<script>{RUN}</script>"),
    "script in a name": SVG.format("<title><i></title></svg>") + f'<img src=x onerror="{RUN}">',
    "ontoggle": f'<details open ontoggle="{RUN}">x</details>',
    "onbegin": SVG.format(f'<animate onbegin="{RUN}" attributeName="x" dur="1s"/>'),
    "srcdoc": f"<iframe srcdoc=\"<script>parent.{RUN}</script>\"></iframe>",
    "frame": f'<iframe src="javascript:parent.{RUN}"></iframe>',
    "link": f'<a href="{LINK}">x</a>',
    "tab in a link": f'<a href="java&#9;script:void({RUN})">x</a>',
    "link in SVG": SVG.format(
        f'<a xlink:href="{LINK}"><text y="9">x</text></a>'),
    "action": f'<form action="{LINK}"><button>x</button></form>',
    "formaction": f'<form><button formaction="{LINK}">x</button></form>',
}
ELSEWHERE = "http://127.0.0.1:PORT/"                # of a server that `visit` starts
LOADING = {
    "picture": f'<img src="{ELSEWHERE}">',
    "srcset": f'<img srcset="{ELSEWHERE}">',
    "picture in SVG": SVG.format(f'<image href="{ELSEWHERE}" width="9" height="9"/>'),
    "url": f'<p style="background:url({ELSEWHERE})">x</p>',
    "escaped url": f'<p style="background:\\75\\72\\6c ({ELSEWHERE})">x</p>',
    "image-set": f"<p style=\"background:image-set('{ELSEWHERE}' 1x)\">x</p>",
    "import": f"<style>@import url({ELSEWHERE});</style>",
    "style sheet": f'<link rel="stylesheet" href="{ELSEWHERE}">',
    "object": f'<object data="{ELSEWHERE}"></object>',
    "video": f'<video poster="{ELSEWHERE}" autoplay></video>',
    "form": f'<form action="{ELSEWHERE}"><button>x</button></form>',
}
LEADING_AWAY = {  # a policy does not hinder the second
    "base": '<base href="http://127.0.0.1:PORT/">',
    "refresh": '<meta http-equiv="refresh" content="0;url=about:blank">',
}
PAYLOADS = RUNNING | LOADING | LEADING_AWAY
REFUSED = {kind: text for kind, text in PAYLOADS.items() if kind != "import"} | {
    "data in a link": '<a href="data:text/html,x">x</a>', "file": '<a href="file:///etc">x</a>',
    "use": SVG.format('<use href="data:image/svg+xml,x#y"></use>'), "unknown": "<name>"}
NAMES = (f'<svg onload="{RUN}">', f'<img src=x onerror="{RUN}">', f"[link](javascript:{RUN})",
         "`<b>` | __b__ ![](x) &lt;b&gt; $x")
SHOWN = [
    "<b>b</b>", '<img alt="x" src="data:image/png;base64,AAAA">', "<a href=\"#x\">x</a>",
    '<a href="2_b.html#x">x</a>', '<a href="https://example.org/?a=1&amp;b=2">x</a>',
    '<a href="mailto:a@example.org">x</a>', "<details open=\"\"><summary>s</summary>x</details>",
    '<table border="1" class="dataframe"><tbody><tr style="text-align: right;"><th>x</th></tr>'
    "</tbody></table>",
    SVG.format('<defs><clipPath id="c"><path d="M0 0"></path></clipPath></defs>'
               '<g clip-path="url(#c)" style="fill: rgb(1, 2, 3)"><use href="#c"></use></g>'
               "<text>a &lt; b</text>")]


def page_of(*cells, name="1_x"):
    text, _ = html_page(Path(f"{name}.ipynb"), new_notebook(cells=list(cells)), [])
    return text


def shown(**data):
    """A code cell that shows an output of these kinds, whose `_` stands for "/"."""
    return new_code_cell(outputs=[new_output("display_data", {
        kind.replace("_", "/"): text for kind, text in data.items()})])


@pytest.mark.parametrize("text", SHOWN)
def test_harmless_html_is_shown_as_it_is(text, capsys):
    assert sanitized(text, "1_x.ipynb") == text and capsys.readouterr().err == ""
    assert text in page_of(shown(text_html=text)) and text in page_of(new_markdown_cell(text))


def test_markup_that_no_browser_knows_is_no_error():
    assert sanitized("a < b <![if x]> c <!y> <?z?>", "1_x.ipynb") == "a &lt; b  c  "


@pytest.mark.parametrize("kind", REFUSED)
def test_what_runs_loads_or_sends_is_refused_in_text_and_outputs_of_pages_and_pdf(kind):
    name, cells = Path("1_x.ipynb"), [
        new_markdown_cell(f"Text {REFUSED[kind]}"), shown(text_markdown=REFUSED[kind]),
        shown(text_html=REFUSED[kind])]
    for number, cell in enumerate(cells):
        book = new_notebook(cells=[new_markdown_cell("# T\n\n## Here"), cell])
        for made in (lambda book: html_page(name, book, []),
                     lambda book: typst_files([(name, book)])):
            with pytest.raises(NotebookError, match="^1_x.ipynb, section 'Here': the report cannot "
                                                    "show <.*>: it holds text, tables,") as caught:
                made(book)
            assert "\n" not in str(caught.value), number


def test_what_only_changes_looks_is_left_out_with_a_notice(capsys):
    text = ("<div><style scoped>.dataframe td { color: red }</style><table bgcolor=\"red\"><tbody>"
            "<tr><td>1</td></tr></tbody></table></div>")
    page = page_of(new_markdown_cell("# Name\n\n## Here"), shown(text_html=text), name="looks")
    assert "<div><table><tbody><tr><td>1</td></tr></tbody></table></div>" in page
    told = capsys.readouterr().err.splitlines()
    assert [line.split(" leaves out ")[1].split(",")[0] for line in told] == [
        "<style>", '<style scoped="">', '<table bgcolor="red">']
    assert all(line.startswith("looks.ipynb, section 'Here': ") for line in told)


def test_outputs_that_are_no_html_are_text_or_pictures():
    cells = [shown(**{"image_svg+xml": SVG.format(f"<script>{RUN}</script>")}),
             shown(image_png=f'"><img src=x onerror="{RUN}">'), shown(text_plain="<script>"),
             new_code_cell("'<script>'", metadata={"magics_language": '"><script>'},
                           outputs=[new_output("stream", text="<script>")])]
    with pytest.warns(UserWarning, match="No lexer found"):
        page = page_of(*cells)
    assert "<script" not in page and "onerror=" not in re.sub('alt="[^"]*"|src="[^"]*"', "", page)
    assert page.count("&lt;script&gt;") >= 3


def test_the_policy_allows_what_the_build_put_there_only():
    still, moving = page_of(), page_of(shown(text_html='<p class="live">x</p>'))
    (policy,), (other,) = POLICY.findall(still), POLICY.findall(moving)
    assert re.fullmatch(
        r"default-src 'none'; img-src data:; script-src 'none'; style-src 'unsafe-inline'; "
        r"style-src-elem 'sha256-[\w+/]{43}='; base-uri 'none'; form-action 'none'", policy)
    assert re.search(r"script-src 'sha256-[\w+/]{43}=';", other)
    assert still.index("Content-Security-Policy") < still.index("<style>")


@pytest.mark.parametrize("name", NAMES)
def test_a_name_stays_the_same_text_in_markdown(name):
    table = f"| a |\n|--|\n| {plain(name)} |"
    page = page_of(new_markdown_cell(f"{plain(name)}\n\n{code(name)}\n\n{table}"))
    assert [html.unescape(text) for text in re.findall(
        r"<(?:p|code|td)>([^<]+)</", page[page.index("<main>"):])] == [name] * 3


def test_characters_that_are_not_seen_are_spaces():
    assert plain("a\nb\u202ec\ue0000\ue001") == "a b c 0 "
    assert plain("1\u00a0m") == "1\u00a0m"


# In the browser.

NOTEBOOK = """from slamlib.notebook import *
from slamlib.slam import *
drives = start()
with_sensor(drives, "uwb", "ranges")
drives, found = solved(drives, ["problem1"])
for drive, solution, files in write_results(drives, found):
    answer("Q", "M", "I", [result_sentence(drive, solution)], f"{files} in {code(drive.name)}")
table(["a"], [[plain(drive.name)] for drive in drives])"""


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """The files of a report on datasets with hostile names, by an author with another one."""
    folder = tmp_path_factory.mktemp("named")
    dataset, truth = simulate("short", seed=1)
    dataset, truth = dataset.first(60).without("uwb"), replace(truth, poses=truth.poses[:60])
    for number, name in enumerate(NAMES):
        write_dataset(folder / "data" / name, dataset, truth if number else None)
    (folder / "notebooks").mkdir()
    nbformat.write(new_notebook(cells=[new_markdown_cell("# 1. Names"), new_code_cell(NOTEBOOK)]),
                   folder / "notebooks" / "1_names.ipynb")
    return build_report(folder / "notebooks", folder / "data", folder / "report",
                        folder / "results",
                        options=Options(Cover(title=NAMES[1], author=NAMES[0]))).files


@pytest.fixture(scope="module")
def server():
    """A server on this machine that counts in `asked` what it is asked for."""
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.server.asked.append(self.path)
            self.send_error(404)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.asked = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def visit(named, server, chromium, tmp_path):
    """A function that opens a page (str), clicks what can be clicked, and says what happened.

    It waits so many ms after both.

    The report `named` is built before the browser starts, see `chromium`.
    """
    context = chromium.new_context()
    path = tmp_path / "page.html"

    def happened(text, wait=200):
        page = context.new_page()
        server.asked.clear()
        path.write_text(text.replace("PORT", str(server.server_port)), encoding="utf-8")
        page.goto(path.as_uri(), wait_until="load")
        page.wait_for_timeout(wait)
        titles = [page.title()]                 # a click may lead to a page without a title
        away = page.url != path.as_uri() or page.evaluate("document.baseURI") != page.url
        if not away:
            page.evaluate("""() => document.querySelectorAll("main :is(a, button)").forEach(e =>
                !/^[^:]*$|html|pdf|mat$/.test(e.getAttribute("href") ?? "x:") && e.dispatchEvent(
                    new MouseEvent("click", {bubbles: true, cancelable: true})))""")
            page.wait_for_timeout(wait)
        ran = "ran" in [*titles, page.title()]
        page.close()
        return ["ran"] * ran + ["away"] * away + ["asked"] * bool(server.asked)

    yield happened
    context.close()


def put(text, page):
    """A page with text at its end."""
    return page.replace("</main>", f"{text}</main>")


@pytest.mark.slow
@pytest.mark.parametrize("kind", PAYLOADS)
def test_a_payload_does_something_in_a_page_without_policy(kind, visit):
    """Otherwise the next test could not fail."""
    expected = "ran" if kind in RUNNING else "asked" if kind in LOADING else "away"
    page = put(PAYLOADS[kind], POLICY.sub("", page_of()))
    assert any(expected in visit(page, wait) for wait in (50, 500, 5000))    # ms: a busy machine


@pytest.mark.slow
def test_no_payload_does_anything_once_sanitized_nor_under_the_policy(visit):
    apart = "<hr>".join
    assert visit(put(apart(map(cleaned, PAYLOADS.values())), POLICY.sub("", page_of()))) == []
    assert visit(put(apart([*RUNNING.values(), *LOADING.values(), PAYLOADS["base"]]),
                     page_of())) == []


@pytest.mark.slow
def test_datasets_and_titles_with_hostile_names_are_shown_as_text(named, visit):
    for path in named[:2]:
        page = path.read_text(encoding="utf-8")
        body = page[page.index("<main>"):]
        assert visit(POLICY.sub("", page)) == visit(page) == []
        assert not re.search(r'<svg onload|<img src="?x|href="javascript|<b>', body)
        text = html.unescape(re.sub("<[^>]*>", "", body))
        assert all(text.count(name) > 1 for name in NAMES), path.name


@pytest.mark.slow
@pytest.mark.usefixtures("look")
def test_names_and_sentences_of_points_in_a_figure_are_text():
    fig, ((ax,),) = plotting.panels(1)
    ax.set_title(NAMES[0])
    inline.tell(ax, np.zeros((1, 2)), [f"marker {NAMES[1]}"], f"Map of {NAMES[0]}\">")
    outputs = inline.outputs(fig, plotting.svg_pictures(fig))
    page = page_of(new_code_cell(outputs=[new_output("display_data", outputs)]))
    plt.close(fig)
    inside = page[page.index('<figure class="inline">'):]
    assert "<svg onload" not in re.sub('aria-label="[^"]*"', "", inside)
    assert inside.count("&lt;img src=x") == 2 and "<img" not in inside
