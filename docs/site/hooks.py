"""What MkDocs is given beside its settings: search without the network."""

from typing import Any

from mkdocs.utils import get_relative_url

# The theme loads its own worker for pages that are read from a disk from this address.
REMOTE = "https://unpkg.com/iframe-worker/shim"
LOCAL = "disk_search.js"


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """The page with the site's own worker."""
    return output.replace(REMOTE, get_relative_url(LOCAL, page.url))


def on_post_template(output: str, **_: Any) -> str:
    """The page for an address that leads nowhere, too."""
    return output.replace(REMOTE, LOCAL)
