"""Self-contained pages: templates, style, terms, and the page of single layers of the verdict."""
