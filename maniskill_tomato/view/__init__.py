"""The browser viewer: episodes recorded step by step, and a page that draws one step."""
