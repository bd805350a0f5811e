"""Flower's side of a robot: a ``ClientApp`` around whoever learns."""

from collections.abc import Callable

from fcslam.errors import FcslamError
from fcslam.federated.client import FederatedClient
from fcslam.federated.flower import ClientApp, Context, Error, Message
from fcslam.federated.messages import client_reply, read_request, weights_to_record

CLIENT_ERROR = 1000
"""Code of an error that the robot explains; Flower's own are below."""

Handler = Callable[[Message, FederatedClient], Message]


def build_client_app(learner_of: Callable[[Context], FederatedClient]) -> ClientApp:
    """The app of a robot that a Flower context stands for. What a robot cannot do it answers with a reason."""
    app = ClientApp()

    def handled(handler: Handler) -> Callable[[Message, Context], Message]:
        def handle(message: Message, context: Context) -> Message:
            try:
                return handler(message, learner_of(context))
            except FcslamError as error:
                return Message(Error(CLIENT_ERROR, " ".join(str(error).split())), reply_to=message)

        return handle

    app.query()(handled(_present))
    app.train()(handled(_train))
    app.evaluate()(handled(_evaluate))
    return app


def _present(message: Message, learner: FederatedClient) -> Message:
    return Message(client_reply(learner.name, "", {}), reply_to=message)


def _train(message: Message, learner: FederatedClient) -> Message:
    order = read_request(message.content)
    learned = learner.learn(order.weights, order.round_number, order.run, order.settings)
    arrays = weights_to_record(learned.weights)
    return Message(client_reply(learner.name, order.version, learned.losses, arrays), reply_to=message)


def _evaluate(message: Message, learner: FederatedClient) -> Message:
    order = read_request(message.content)
    figures = learner.judge(order.weights, order.settings)
    return Message(client_reply(learner.name, order.version, figures), reply_to=message)
