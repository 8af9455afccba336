"""What tests of cards share: HTML taken apart, pictures decoded."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import PIL.Image

VOID = {"img", "br"}


class Parts(HTMLParser):
    """Text, pictures and attributes of HTML whose tags are all closed in order."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.styles, self.files, self.words = [], [], [], [], []
        self.html = html
        self.feed(html)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        found = dict(attributes)
        self.styles.append(found.get("style", ""))
        assert not any(name.startswith("on") for name in found), found
        if tag == "img":
            assert found["alt"], "a picture without words"
            kind, data = found["src"].split(";base64,")
            self.files.append((kind.removeprefix("data:image/"), base64.b64decode(data)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open, f"</{tag}> closes nothing"
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(word.strip() for word in self.words if word.strip())

    @property
    def pictures(self):
        return [np.asarray(PIL.Image.open(io.BytesIO(f)).convert("RGB")) for _, f in self.files]


def parts(thing):
    """The parts of an object's card, which is small and needs nothing from elsewhere."""
    found = thing._repr_mimebundle_()
    assert set(found) == {"text/plain", "text/html"}, found["text/plain"][-300:]
    assert found["text/plain"] == repr(thing)
    html = found["text/html"]
    # The limit of what notebooks keep of a card; see `markup.MOST`.
    assert len(html) < 150_000
    # Letters of a picture may spell anything.
    bare = re.sub('"data:image/[^"]*"', "", html)
    for word in ("http", "<script", "<style", "<link", "url("):
        assert word not in bare
    cut = Parts(html)
    for image in cut.pictures:
        assert image.std() > 0.0
    return cut


def none(thing):
    """The last line of the text of an object without a card."""
    found = thing._repr_mimebundle_()
    assert set(found) == {"text/plain"}
    return found["text/plain"].split("\n")[-1]


def like(image, colour, within=40):
    """Where a picture has about a colour, [h, w]."""
    return (np.abs(image.astype(int) - np.asarray(colour)).max(-1)) <= within
