"""Pages that need nothing beside them: templates, style, terms, and the page of single layers of the verdict."""
