"""The bus: the only folder that knows Zenoh.

`session` opens it, `keys` names things on it, `publisher` says what robots say, `calls` and
`queries` answer other programs, and `client` is such a program. Import what you need from the
module itself: `keys` costs nothing, the others load Zenoh.
"""
