"""Parts of a written page, files that it would load from elsewhere, and orders to a live page."""

import html.parser


class Page(html.parser.HTMLParser):
    """Collects ids and what is loaded from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.foreign = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            fetching = ("src", "href", "srcset", "data", "poster", "action", "xlink:href")
            if name in fetching and not (value or "").startswith(("data:", "#")):
                self.foreign.append(value)


def order(page, name, **values):
    """Carry an order to a live page out as a POST does, and return the answer."""
    return page.orders[name].carry_out(name, values)
