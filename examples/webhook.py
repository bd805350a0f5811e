"""Tell a webhook, once for each cause, when a fleet needs a person.

    python examples/webhook.py http://127.0.0.1:8340 https://hooks.example/fleet [LOOKS]

Tokens are in the environment variables FCSLAM_TOKEN and WEBHOOK_TOKEN, because logs show addresses.
"""

import os
import sys
import time

import httpx


def needs(service: httpx.Client) -> dict[str, str]:
    try:
        fleet, robots = (service.get(f"/api/v1/{path}").raise_for_status().json() for path in ("fleet", "robots"))
    except httpx.HTTPError as error:
        return {"service": f"the service does not answer: {error}"}
    silent = [r for r in robots if not r["ended"] and not r["removed"] and 60.0 < (r["last_heard_s"] or 0.0) < 3600.0]
    found = {r["robot"]: f"{r['robot']} has been silent for {r['last_heard_s']:.0f} s" for r in silent}
    return found | ({"map": f"the map lacks the last {fleet['lacking_s']:.0f} s"} if fleet["lacking_s"] > 30.0 else {})


def main(service: str, hook: str, looks: float = float("inf")) -> None:
    names = "FCSLAM_TOKEN", "WEBHOOK_TOKEN"
    bearer = [{"Authorization": f"Bearer {os.environ[name]}"} if name in os.environ else {} for name in names]
    with httpx.Client(base_url=service, headers=bearer[0]) as asked, httpx.Client(headers=bearer[1]) as told:
        known: dict[str, str] = {}
        while (looks := looks - 1) >= 0:
            found = needs(asked)
            for cause in found.keys() - known.keys():
                told.post(hook, json={"cause": cause, "text": found[cause], "service": service})
            known = found
            time.sleep(5.0 if looks else 0.0)


if __name__ == "__main__":
    main(*sys.argv[1:3], *map(float, sys.argv[3:4]))
