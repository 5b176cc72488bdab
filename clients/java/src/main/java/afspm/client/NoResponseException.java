package afspm.client;

import afspm.Control.ControlResponse;

/** No answer arrived in time. */
public class NoResponseException extends RequestException {
    NoResponseException(String what, String reason, int detail) {
        super(what, ControlResponse.REP_NO_RESPONSE_VALUE, reason, detail);
    }
}
