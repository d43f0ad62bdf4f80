from .datasets import Collection
from .hapi import make_app
from .server import Server

__all__ = [
    "Collection",
    "Server",
    "make_app",
]
