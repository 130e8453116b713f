from .method import METHOD as METHOD
