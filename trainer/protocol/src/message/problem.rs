//! Refusals: their form and their codes.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The reason for a refusal, as clients read it. The server sends it as [`Problem`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ApiError {
    /// Code for programs, one of [`CODES`].
    pub code: String,
    /// Description for users.
    #[serde(alias = "detail")]
    pub message: String,
    /// Remedy, if there is one.
    pub hint: Option<String>,
}

/// Answer to every refused call: problem details (RFC 9457) with our code and hint, sent as [`Problem::CONTENT_TYPE`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Problem {
    /// Kind of the problem as a URI: `urn:stride:problem:` and the code.
    #[serde(rename = "type")]
    pub kind: String,
    /// The kind in words, the same for each problem of the kind.
    pub title: String,
    /// The answer's HTTP status.
    pub status: u16,
    /// Description for users.
    pub detail: String,
    /// Code for programs, one of [`CODES`].
    pub code: String,
    /// Remedy, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
}

impl Problem {
    /// The media type of problems.
    pub const CONTENT_TYPE: &str = "application/problem+json";

    /// The problem of a call that is answered with `status`.
    pub fn new(status: u16, error: ApiError) -> Self {
        let ApiError { code, message: detail, hint } = error;
        let title = CODES.iter().find(|(known, _)| *known == code).map_or("Refused", |(_, title)| *title);
        Self { kind: format!("urn:stride:problem:{code}"), title: title.to_owned(), status, detail, code, hint }
    }
}

/// Codes of refusals with their titles.
pub const CODES: [(&str, &str); 26] = [
    ("arrived-damaged", "The blob was damaged on its way"),
    ("busy", "The server has too much to do"),
    ("conflict", "The request conflicts with the current state"),
    ("cut", "The request ended early"),
    ("damaged", "The stored data is damaged"),
    ("failed", "The server has failed"),
    ("forbidden", "The token does not allow this"),
    ("gate", "A gate does not hold"),
    ("host", "The server has another name"),
    ("internal", "The server made a mistake"),
    ("invalid", "The request is invalid"),
    ("method", "The path has no such method"),
    ("name-held", "Another process holds the name"),
    ("not-found", "There is no such object"),
    ("offset", "The part does not follow the stored ones"),
    ("origin", "Pages of other sites may not call this server"),
    ("slow", "The request came too slowly"),
    ("stale-fence", "The grant has been superseded"),
    ("storage", "The store does not take data"),
    ("tls", "The server speaks TLS"),
    ("too-large", "The data is too large"),
    ("unauthorized", "The call shows no valid token"),
    ("unproven", "The data is not proven complete"),
    ("unreachable", "The blob storage does not answer"),
    ("unvouched", "The call does not prove its upload"),
    ("used-up", "A limit is used up"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_reads_as_the_error_that_it_tells() {
        let error = ApiError { code: "busy".into(), message: "too much".into(), hint: Some("wait".into()) };
        let problem = serde_json::to_value(Problem::new(429, error.clone())).unwrap_or_default();
        assert_eq!(problem["title"], "The server has too much to do");
        assert_eq!(problem["type"], "urn:stride:problem:busy");
        assert_eq!(serde_json::from_value::<ApiError>(problem).ok(), Some(error.clone()));
        let plain = serde_json::to_value(&error).unwrap_or_default();
        assert_eq!(serde_json::from_value::<ApiError>(plain).ok(), Some(error));
        assert!(CODES.is_sorted(), "{CODES:?}");
    }
}
