package afspm.client;

/** Control was not given in time, or the problem to be solved is not flagged. */
public class ControlLostException extends RequestException {
    ControlLostException(String what, Response response) {
        super(what, response.code(), response.reason(), response.detail());
    }
}
