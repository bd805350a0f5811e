"""The page's files: small, from this service alone, and without a token."""

import asyncio
import re

import httpx
from fastapi import FastAPI

from fcslam.page.routes import ASSETS, FILES, page_router

LARGEST_BYTES = 150_000


def test_the_page_is_served_and_forbids_scripts_and_hosts_that_are_not_its_own() -> None:
    app = FastAPI(docs_url=None)
    app.include_router(page_router())

    async def get(path: str) -> httpx.Response:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
            return await client.get(path)

    for path, (name, media_type) in FILES.items():
        answer = asyncio.run(get(path))
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith(media_type)
        assert answer.content == (ASSETS / name).read_bytes()
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy


def test_the_page_is_small_and_names_no_other_host() -> None:
    texts = [path.read_text(encoding="utf-8") for path in ASSETS.iterdir()]
    assert sum(len(text.encode()) for text in texts) < LARGEST_BYTES
    assert not any(re.search(r"https?:|innerHTML|style=|<script(?! type=\"module\" src)", text) for text in texts)
