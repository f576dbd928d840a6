"""Before numpy is imported: matrices are small, and more threads only wait for each other."""

import os
import shutil

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def chromium():
    """A headless Chromium that finds no host but this one (a playwright Browser).

    While it runs asyncio counts as running in this thread, and no report can be built: a module at a
    time, and after the pages that it looks at.
    """
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser here: none of {', '.join(BROWSERS)}")
    from playwright.sync_api import sync_playwright
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=[
            "--no-sandbox", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"])
        yield browser
        browser.close()
