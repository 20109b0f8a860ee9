"""The documentation as a site: which pages it has, the generated ones, and how Sphinx builds it."""
