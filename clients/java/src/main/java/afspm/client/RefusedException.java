package afspm.client;

/** The scheduler, a limit or the microscope said no. */
public class RefusedException extends RequestException {
    RefusedException(String what, Response response) {
        super(what, response.code(), response.reason(), response.detail());
    }
}
