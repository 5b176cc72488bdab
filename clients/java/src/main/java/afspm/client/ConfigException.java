package afspm.client;

/** The launch line, a key or an address can't work: a restart would fail the same way. */
public class ConfigException extends AfspmException {
    public ConfigException(String what) {
        super(what);
    }
}
