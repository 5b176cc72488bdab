package afspm.client;

import java.security.SecureRandom;
import java.util.HashMap;
import java.util.List;
import java.util.Map;

/** Sends requests to the scheduler: each has an id, is repeated with it until it is answered, and is executed once. */
final class Requests {
    static final byte[] NOTHING = {};
    /** Longer than the scheduler waits for the microscope, so that its NO_RESPONSE arrives before the timeout. */
    private static final double LONGER_THAN_THE_SCHEDULER = 1.2;

    private final Link link;
    private final Launch launch;
    private final String session;
    private final Map<String, Response> answers = new HashMap<>(); // null: not yet received
    private int requests;
    private boolean isConnected;
    private int connections;

    Requests(Link link) {
        this.link = link;
        this.launch = link.launch;
        String life = String.format("%08x", new SecureRandom().nextInt());
        session = launch.run.isEmpty() ? life : launch.run + "-" + life;
    }

    /** Return an id for a request, unique over all lives of this component. */
    String nextId() {
        synchronized (link) {
            return launch.name + "/" + session + "/" + ++requests;
        }
    }

    boolean isConnected() {
        synchronized (link) {
            return isConnected;
        }
    }

    /** Return the number of connections so far. */
    int connections() {
        synchronized (link) {
            return connections;
        }
    }

    /** Whether the connection was replaced since a number of connections. */
    boolean isChangedSince(int before) {
        synchronized (link) {
            return !isConnected || connections != before;
        }
    }

    /** Send a request without waiting for its answer. */
    void sendOnly(int number) {
        if (isConnected()) {
            link.send(Wire.request(number, NOTHING, nextId()));
        }
    }

    Response ask(int number, byte[] object, long deadline) {
        return ask(number, object, nextId(), deadline);
    }

    /** Send a request and return its answer, also a refusal. */
    Response ask(int number, byte[] object, String id, long deadline) {
        if (launch.sockets.control == null) {
            throw new ConfigException(launch.name + " was given no scheduler to ask");
        }
        List<byte[]> frames = Wire.request(number, object, id);
        link.change(() -> answers.put(id, null));
        try {
            boolean wasSent = false;
            for (int tries = 0; tries <= launch.requestRetries;) {
                awaitScheduler(number, wasSent, deadline);
                int before = connections();
                link.send(frames);
                wasSent = true;
                link.await(() -> answers.get(id) != null || isChangedSince(before),
                        Time.earlier(launch.requestTimeoutS * LONGER_THAN_THE_SCHEDULER, deadline));
                Response response = answer(id);
                if (response != null) {
                    return checked(response);
                }
                if (Time.isOver(deadline)) {
                    break;
                }
                if (!isChangedSince(before)) { // a restart of the scheduler does not count as silence
                    tries += 1;
                    link.reconnect();
                    link.await(() -> isChangedSince(before), Time.deadline(1));
                }
            }
        } finally {
            link.change(() -> answers.remove(id));
        }
        throw new NoResponseException("request " + number, "it was not answered; it may or may not have been carried out", Response.OUTCOME_UNKNOWN);
    }

    /** Send a request that needs no control; anything but success is thrown. */
    Response order(String what, int number, byte[] object) {
        Response response = ask(number, object, Long.MAX_VALUE);
        if (!response.ok()) {
            throw new RefusedException(what, response);
        }
        return response;
    }

    void onConnected(boolean isThere) {
        link.change(() -> {
            isConnected = isThere;
            connections += isThere ? 1 : 0;
        });
        sendOnly(Wire.CLOCK_REQUEST); // its id contains the client's name and run
    }

    void onResponse(Response response) {
        if (response.code() == Wire.OTHER_RUN_RESPONSE) {
            link.fail(new ConfigException(launch.sockets.control + ": " + response.reason()));
            return;
        }
        link.change(() -> {
            if (answers.containsKey(response.id())) { // otherwise a late answer to a request that was given up
                answers.put(response.id(), response);
            }
        });
    }

    private void awaitScheduler(int number, boolean wasSent, long deadline) {
        double patienceS = launch.requestTimeoutS * (1 + launch.requestRetries);
        if (!link.await(this::isConnected, Time.earlier(patienceS, deadline))) {
            throw new NoResponseException("request " + number, "the scheduler does not answer; is the experiment running?",
                    wasSent ? Response.OUTCOME_UNKNOWN : Response.NOT_SENT);
        }
    }

    private Response answer(String id) {
        synchronized (link) {
            return answers.get(id);
        }
    }

    private Response checked(Response response) {
        if (response.detail() == Response.EXPERIMENT_ENDED) {
            link.fail(new ExperimentEndedException("the experiment has ended"));
            throw link.over();
        }
        return response;
    }
}
