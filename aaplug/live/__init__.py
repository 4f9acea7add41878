"""A scene shown live: a page in the browser, drawn by the rasterizer of this machine and streamed.

`subject` is what is looked at, `messages` what a page may ask for.  `pictures` draws what one page asks for, step by
step; `studio` is the one thread that takes these steps, for all pages in turn; `server` speaks with the pages.
"""
