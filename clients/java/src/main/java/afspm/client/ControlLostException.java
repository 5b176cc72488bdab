package afspm.client;

/** Control was not granted in time, or the problem to solve is not flagged. */
public class ControlLostException extends RequestException {
    ControlLostException(String what, Response response) {
        super(what, response.code(), response.reason(), response.detail());
    }
}
