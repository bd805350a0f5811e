"""Wraps a federated client into Flower's ``ClientApp``."""

from collections.abc import Callable, Iterable
from typing import Final

from fcslam.errors import FcslamError
from fcslam.learning.federated.client import FederatedClient, JudgingClient
from fcslam.learning.federated.flower import ClientApp, Context, Error, InProcessGrid, Message
from fcslam.learning.federated.messages import PAIRS_KEY, client_reply, read_request, weights_to_record
from fcslam.learning.federated.weights import shared_weights

CLIENT_ERROR: Final = 1000
"""Code of an error that a client explains; Flower's own codes are smaller."""

Handler = Callable[[Message, FederatedClient], Message]


def in_process_grid(clients: Iterable[FederatedClient]) -> InProcessGrid:
    """A fleet of these clients in this process."""
    return InProcessGrid({client.name: build_client_app(client) for client in clients})


def build_client_app(client: FederatedClient) -> ClientApp:
    """The app that answers the training and evaluation requests of a client."""
    app = ClientApp()

    def handled(handler: Handler) -> Callable[[Message, Context], Message]:
        def handle(message: Message, _context: Context) -> Message:
            try:
                return handler(message, client)
            except FcslamError as error:
                return Message(Error(CLIENT_ERROR, " ".join(str(error).split())), reply_to=message)

        return handle

    app.train()(handled(_train))
    app.evaluate()(handled(_evaluate))
    return app


def _train(message: Message, client: FederatedClient) -> Message:
    request = read_request(message.content)
    update = client.train(request.weights, request.round_number, request.run_id, request.settings)
    arrays = weights_to_record(shared_weights(update.weights, request.settings.private))
    return Message(client_reply(client.name, request.version, update.losses, arrays), reply_to=message)


def _evaluate(message: Message, client: FederatedClient) -> Message:
    request = read_request(message.content)
    if request.settings.on_revisits and isinstance(client, JudgingClient):
        rows = client.judge(request.weights, request.round_number, request.run_id, request.settings)
        arrays = weights_to_record({PAIRS_KEY: rows})
        return Message(client_reply(client.name, request.version, {}, arrays), reply_to=message)
    metrics = client.evaluate(request.weights, request.round_number, request.run_id, request.settings)
    return Message(client_reply(client.name, request.version, metrics), reply_to=message)
