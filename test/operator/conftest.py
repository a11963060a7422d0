# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A browser for the tests of the page, each file of them with one of its own."""

import pytest


@pytest.fixture(scope='module')
def browser():
    """Return Chromium, to open pages in."""
    # It needs what files of tests look for first.
    from operator_harness import chromium
    with chromium() as browser:
        yield browser


@pytest.fixture
def opened(browser):
    """Return what opens a page, which is to have no errors."""
    from operator_harness import Page
    pages = []

    def open_page(*arguments, **options):
        pages.append(Page(browser, *arguments, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.context.close()
        assert not page.errors
