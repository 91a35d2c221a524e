"""A page as a test reads it."""

from html.parser import HTMLParser

VOID = {"meta", "link", "img", "br", "input", "hr", "circle", "path"}


class Page(HTMLParser):
    """Elements, ids, links and the text of every section; complains of tags that do not match."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.sources, self.tags = [], [], [], [], []
        self.sections, self.text, self.script, self.images = {}, "", "", []
        self.feed(text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append((tag, attrs))
        if "id" in attrs:
            self.ids.append(attrs["id"])
        if "href" in attrs:
            self.links.append(attrs["href"])
        if "src" in attrs:
            self.sources.append(attrs["src"])
        if tag == "img":
            self.images.append(attrs)
        if tag not in VOID:
            self.open.append((tag, attrs.get("id")))

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open[-1][0] == tag, f"</{tag}> closes <{self.open[-1][0]}>"
        self.open.pop()

    def handle_data(self, data):
        if any(tag in ("script", "style") for tag, _ in self.open):
            if self.open[-1] == ("script", "chart-data"):
                self.script += data
            return
        data = data.replace("\N{NO-BREAK SPACE}", " ")  # where a line must not break is another question
        self.text += data
        for tag, name in self.open:
            if tag == "section":
                self.sections[name] = self.sections.get(name, "") + data
